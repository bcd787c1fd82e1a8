# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Declare every parameter of every node: default, unit, range and meaning.

The nodes take their parameters from here.  Tests compare the tables of ``docs/graph.md`` and the
YAML files in ``config/`` with these declarations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from piezo_ident.identification.settings import SOLVERS
from piezo_ident.live.predictor import LEVEL
from piezo_ident.model.observer import ACCEPT_AFTER, HORIZON

#: topics of blocks of samples, and topics of texts that a late node must still receive
SAMPLE_TOPICS = (
    'voltage',
    'displacement',
    'applied_voltage',
    'prediction',
    'residual',
    'estimate',
    'reference',
    'tracking_error',
)
LATCHED_TOPICS = ('model', 'report')


@dataclass(frozen=True)
class Declaration:
    """
    Declaration of one parameter, whose type is the type of its default.

    `description` is the meaning without the `unit`.  A number lies in the range from `low` to
    `high`, both included, and a text is one of the `choices`, if there are any.  A `read_only`
    parameter is set only when the node starts.
    """

    name: str
    default: bool | int | float | str | tuple[str, ...]
    description: str
    unit: str = ''
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = False


def with_axes(topics: Sequence[str], axes: Sequence[str]) -> list[str]:
    """Add to topics of the first axis the topics of further axes, such as ``voltage_b``."""
    names, kinds = [name for name in axes if name], (*SAMPLE_TOPICS, 'corrections')
    return [*topics, *(f'{t}_{name}' for name in names for t in topics if t in kinds)]


def _volts(name: str, default: float, text: str) -> Declaration:
    return Declaration(name, default, text, 'V', -1000.0, 1000.0)


_at_start, _SEEDS = partial(Declaration, read_only=True), 2**31 - 1

_RATE = _at_start(
    'sample_rate', 20e3, 'rate of the sample clock that starts with the excitation', 'Hz', 1.0, 1e7
)
_LIMITS = (
    _volts('voltage_low', 0.0, 'lowest voltage ever sent or applied'),
    _volts('voltage_high', 10.0, 'highest voltage ever sent or applied'),
)
_SLEW = Declaration('slew', 40000.0, 'steepest voltage ever sent or applied', 'V/s', 1.0, 1e9)
_REST = (
    _volts('rest', 0.0, 'rest voltage: before a stream, and after a stop or a silence'),
    Declaration(
        'ramp_slew', 20.0, 'top speed of ramps to rest and into a stream', 'V/s', 0.001, 1e6
    ),
)
_LISTENERS = (
    Declaration('subscribers', 1, 'subscribers to wait for before the first block', '1', 0, 100),
    Declaration('wait_limit', 10.0, 'longest wait for the subscribers', 's', 0.0, 3600.0),
)
_MODEL = Declaration('model', '', 'model file to start with; empty: wait for the topic')
_AXES = _at_start(
    'axes',
    ('',),
    'names of further axes, each with topics voltage_<name> and so on; empty names are left out',
)
_WINDOW = Declaration('window', 2.0, 'window of the live or the tracking error', 's', 0.1, 600.0)
_AUTOSTART = _at_start('autostart', False, 'start at once')

EXCITATION = (
    _RATE,
    Declaration('program', 'identification', 'program to play: a name, a path, or YAML text'),
    _at_start(
        'quantity',
        'voltage',
        'topic and unit of the program: voltage in V, or reference in um',
        choices=('voltage', 'reference'),
    ),
    _AXES,
    Declaration('in_turn', False, 'whether the axes play one after the other'),
    Declaration('block_size', 100, 'samples in a block', '1', 2, 100_000),
    Declaration('rate_factor', 1.0, 'speed of the stream over real time', '1', 0.1, 4.0),
    *_LIMITS,
    *_REST,
    *_LISTENERS,
)

STAGE = (
    _at_start('stage', 'paper', 'the stage to simulate: a name or a path'),
    _at_start(
        'seed', -1, 'seed of the sensor noise; -1: the seed of the stage file', '1', -1, _SEEDS
    ),
    *_LIMITS,
    _SLEW,
    *_REST,
    Declaration('silence', 0.5, 'time without a block that ends a stream', 's', 0.01, 3600.0),
)

IDENTIFIER = (
    Declaration('program', 'identification', 'program that ~/run asks the excitation for'),
    Declaration('thresholds', 0, 'number of plays of H; 0: chosen by held-out error', '1', 0, 400),
    Declaration(
        'solver',
        'least_squares',
        'solver of the weights of H; joint: one fit instead of the three steps',
        choices=SOLVERS,
    ),
    Declaration('polish', False, 'whether least squares refine the result of the swarm'),
    Declaration('max_order', 15, 'largest na and nb that are tried', '1', 1, 50),
    Declaration('delay', -1, 'delay of the model; -1: identified', 'samples', -1, 10_000),
    Declaration('seed', 0, 'seed of all random draws', '1', 0, _SEEDS),
    Declaration('swarm_size', 40, 'number of particles', '1', 2, 10_000),
    Declaration('swarm_iterations', 20_000, 'most iterations of the swarm', '1', 1, 10_000_000),
    Declaration('output', '', 'folder into which ~/save writes; empty: none'),
    Declaration('capture_limit', 600.0, 'longest capture that is kept', 's', 1.0, 86_400.0),
    Declaration(
        'excitation_limit',
        20.0,
        'longest wait of ~/run for the excitation and the stage',
        's',
        0.5,
        3600.0,
    ),
    Declaration('model', '', 'file of a model for ~/diagnose; empty: the identified model'),
    Declaration('sweeps_program', 'diagnosis', 'program of ~/diagnose for many motions'),
    Declaration('holds_program', 'holds', 'program of ~/diagnose for holds after steps'),
    Declaration('requests', 2, 'most programs that one ~/diagnose asks for', '1', 0, 10),
    _AXES,
    _at_start(
        'channels',
        ('',),
        'topics of further axes (voltage_<name>, displacement_<name>) and channels (layout '
        't,x_<name>); empty names are left out',
    ),
    _at_start('nice', 5, 'niceness of the process that does the work', '1', 0, 19),
)

MODEL = (
    _MODEL,
    _AXES,
    Declaration(
        'warn_ratio',
        3.0,
        'ratio of live error and error at identification that calls for another identification',
        '1',
        1.0,
        1000.0,
    ),
    _WINDOW,
    _at_start('preview_rate', 50.0, 'rate of the preview and the corrections', 'Hz', 1.0, 200.0),
    Declaration(
        'horizon',
        HORIZON,
        'least age of the displacement that an estimate uses',
        'samples',
        1,
        100_000,
    ),
    Declaration('observe_gain', False, 'whether the estimate follows the gain'),
    Declaration('observe_drift', False, 'whether the estimate follows a drift of the gain'),
    Declaration(
        'adapt',
        'off',
        'what the estimate learns: nothing, the gain, or the hysteresis and creep, too',
        choices=('off', 'gain', 'hysteresis'),
    ),
    Declaration(
        'accept_after', ACCEPT_AFTER, 'age at which a step becomes the new zero', 's', 0.1, 3600.0
    ),
    Declaration('output', '', 'file into which ~/save writes the learnt model; empty: none'),
    _at_start('interval', LEVEL, 'share of the errors that the band holds', '1', 0.01, 0.999),
)

RECORDER = (
    Declaration('output', 'recording', 'bag to write; a number is added when it is there'),
    _at_start('storage', 'mcap', 'format of the bag', choices=('mcap', 'sqlite3')),
    _at_start(
        'topics',
        (
            *SAMPLE_TOPICS,
            *LATCHED_TOPICS,
            'preview',
            'corrections',
            *(f'{node}/status' for node in ('excitation', 'stage', 'identifier', 'model')),
            'feedforward/status',
            '/diagnostics',
        ),
        'topics to record',
    ),
    _AXES,
    Declaration(
        'max_bag_size',
        0,
        'size of a part of the recording, in a folder with a number; 0: one bag',
        'bytes',
        0,
        10**15,
    ),
    Declaration('flush', 0.4, 'longest time that a message waits to be on disk', 's', 0.05, 0.5),
    _RATE,
    _AUTOSTART,
)

PLAYER = (
    Declaration('bag', '', 'bag to replay'),
    Declaration('rate', 1.0, 'speed over that of the recording', '1', 0.1, 4.0),
    Declaration(
        'topics',
        ('voltage', 'displacement'),
        'topics to replay; a recorded model would overwrite the live one',
    ),
    _AXES,
    *_LISTENERS,
    _AUTOSTART,
)

FEEDFORWARD = (
    _RATE,
    _MODEL,
    _AXES,
    _at_start('preview', 0.02, 'delay of the stage behind the reference', 's', 1e-5, 10.0),
    *_LIMITS,
    _SLEW,
    *_REST,
    Declaration(
        'follow',
        'off',
        'corrections by the displacement: none, offset and creep, or the gain, too',
        choices=('off', 'offset', 'gain'),
    ),
    Declaration('silence', 0.5, 'time without a block that ends a reference', 's', 0.05, 3600.0),
    *_LISTENERS,
    _WINDOW,
    Declaration('repetitions', 8, 'most repetitions of one ~/learn', '1', 1, 100),
    Declaration('longest', 60.0, 'longest reference that is kept for ~/learn', 's', 0.1, 3600.0),
)

#: the declarations of each node by its executable
NODES: dict[str, tuple[Declaration, ...]] = {
    'excitation': EXCITATION,
    'stage': STAGE,
    'identifier': IDENTIFIER,
    'model': MODEL,
    'recorder': RECORDER,
    'player': PLAYER,
    'feedforward': FEEDFORWARD,
}
