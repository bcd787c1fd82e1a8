# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a diagnosis is asked for, and what it gives back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import ConfigError, ModelError
from piezo_ident.common.showable import Showable
from piezo_ident.effects import find_effect
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.record.record import Fault, Piece

FORMULA = (
    '100 rms(y - y_hat) / (max y - min y), free run, the zero of each record free; before: the '
    'model as it was given; after: each kind of motion with the parameters fitted to the others'
)


@dataclass(frozen=True)
class DiagnosisSettings:
    """
    How to diagnose.

    Attributes
    ----------
    effects : tuple of str, optional
        Candidates; the whole catalogue when absent.
    without : tuple of str
        Candidates to leave out.
    most_effects : int
        Effects that are added at most.
    most_samples : int
        Samples that are searched and fitted at most, the beginnings of the records: 0.9 to
        1.3 kB each.
    seed : int
        For everything that is drawn by chance.

    Raises
    ------
    ConfigError
        When a name is not in the catalogue, or a number out of range.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> pi.DiagnosisSettings(effects=('creep', 'slew_limit')).most_effects
    4
    """

    effects: tuple[str, ...] | None = None
    without: tuple[str, ...] = ()
    most_effects: int = 4
    most_samples: int = 2_400_000
    seed: int = 0

    def __post_init__(self) -> None:
        for name in (*(self.effects or ()), *self.without):
            try:
                find_effect(name)
            except ModelError as error:
                raise ConfigError(str(error)) from None
        if not 1 <= self.most_effects <= 10:
            raise ConfigError(f'most_effects must be 1 to 10, got {self.most_effects}')
        if self.most_samples < 1000:
            raise ConfigError(f'most_samples must be at least 1000, got {self.most_samples}')
        if self.seed < 0:
            raise ConfigError(f'seed must not be negative, got {self.seed}')


@dataclass(frozen=True)
class FoundParameter:
    """A fitted parameter: value, unit, and standard deviation where there is one."""

    value: float | str | tuple[float, ...]
    unit: str
    std: float | tuple[float, ...] | None


@dataclass(frozen=True, eq=False)
class FoundEffect:
    """
    An effect that was added to the model, in one of the slots of its chain.

    It explains a `share` (0 .. 1) of the explainable part of the residual, of `rms_percent` % of
    stroke.
    """

    name: str
    slot: str
    share: float
    rms_percent: float
    parameters: Mapping[str, FoundParameter]


@dataclass(frozen=True)
class Class:
    """Effects that these data cannot tell apart, and the experiment that would."""

    names: tuple[str, ...]
    separating_experiment: str


@dataclass(frozen=True)
class OtherGain:
    """
    Gain of the stage over that of the model, and what it accounts for.

    Its `share` (0 .. 1) is of what the model as given misses beyond the noise.
    """

    value: float
    share: float


@dataclass(frozen=True)
class Candidate:
    """A candidate that was not added: its share of the explainable part alone, and why not."""

    name: str
    share: float
    why_not: str


@dataclass(frozen=True)
class Unexplained:
    """What is left beyond the noise: share of the explainable part, rms [% of stroke], words."""

    share: float
    rms_percent: float
    description: str


@dataclass(frozen=True)
class Untestable:
    """An effect that these data cannot show, and what would."""

    name: str
    needs: str


@dataclass(frozen=True)
class Errors:
    """Free-run errors in % of stroke: overall, by segment label, by a sine's frequency [Hz]."""

    overall: float
    by_segment: Mapping[str, float]
    by_frequency: Mapping[str, float]


@dataclass(frozen=True)
class Unseen:
    """
    Errors on a record that took no part in a diagnosis, % of its stroke.

    Attributes
    ----------
    record : str
    before, after : float
        Of the model as given and of the refined one; of a record that does not start at rest,
        behind the part from which its start is estimated.
    before_centred, after_centred : float
        The same without the mean of the error: a sensor may have been set to zero again.
    n : int
        Samples judged.
    sines : tuple of (float, float, float)
        Frequency [Hz] and errors before and after, in steady state.
    """

    record: str
    before: float
    after: float
    before_centred: float
    after_centred: float
    n: int
    sines: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True, eq=False)
class Residual:
    """
    One piece with its residuals, measured minus predicted [m], shape (n,).

    By the model as given, by the base model refitted (`before`), and by the refined model; the
    samples of `sound` count.
    """

    record: str
    piece: Piece
    given: Array
    before: Array
    after: Array
    sound: Mask


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Showable):
    """
    Result of a diagnosis.

    Attributes
    ----------
    verdict : {'named', 'class', 'partly_explained', 'refitted', 'unexplained', 'none'}
    sentence : str
        The verdict for a reader.
    given, model : StageModel
        The model that was judged, and the refined one; the same where it stays as given.
    effects : tuple of FoundEffect
        In the order in which they were found.
    group : Class or None
        Effects that these data cannot tell apart; where none was found, those that may hide in
        the H that was refitted.
    unexplained : Unexplained
    candidates : tuple of Candidate
        Best first.
    before, refit, after : Errors
        Of the model as given; of the base model refitted, blocks held out; of the refined model,
        kinds of motion held out as a whole; what follows time counts as it was found in these
        records, and H as refitted with it, though the model leaves both out where there is
        nothing else.
    noise_floor : float or None
        Rms of single samples, % of stroke.
    noise_source : str
    smallest_detectable : float or None
        Rms of the smallest effect that would have been taken, % of stroke.
    untestable : tuple of Untestable
    faults : tuple of Fault
    residuals : tuple of Residual
    records : tuple of str
    blocks : int
        How many blocks were held out in turn.
    warnings : tuple of str
    settings : DiagnosisSettings
    unseen : tuple of Unseen
        Errors on records that took no part.
    law : str
        That of H as it was fitted, of `piezo_ident.operators.hysteresis_law.LAWS`; empty where it
        stays as it was given.
    errors_of_laws : mapping of str to float
        Of H refitted as plays and as wider laws, on kinds of motion held out, % of stroke.
    kinds : tuple of str
        Kinds of motion held out in turn; empty where parts of the data stood for them.
    gain : OtherGain or None
        Where another gain does what a refit of H does.
    set_in : bool
        Whether an effect has set in since the identification, so that shares are of what the model
        misses as it was given; else they are of what the H that fits best leaves.
    outside : float
        Share of the samples whose voltage lies outside the range of the given model.

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> model = pi.SimulatedStage.load('paper').model
    >>> v = 5 - 5 * np.cos(2 * np.pi * 20 * np.arange(20_000) / 20_000)
    >>> record = pi.Record.from_arrays(v, model.simulate(v), sample_rate=20_000)
    >>> result = pi.diagnose(model, record, pi.DiagnosisSettings(effects=('saturation',)))
    >>> result.verdict, result.effects
    ('none', ())
    """

    verdict: str
    sentence: str
    given: StageModel
    model: StageModel
    effects: tuple[FoundEffect, ...]
    group: Class | None
    unexplained: Unexplained
    candidates: tuple[Candidate, ...]
    before: Errors
    refit: Errors
    after: Errors
    noise_floor: float | None
    noise_source: str
    smallest_detectable: float | None
    untestable: tuple[Untestable, ...]
    faults: tuple[Fault, ...]
    residuals: tuple[Residual, ...]
    records: tuple[str, ...]
    blocks: int
    warnings: tuple[str, ...]
    settings: DiagnosisSettings
    unseen: tuple[Unseen, ...] = ()
    law: str = ''
    errors_of_laws: Mapping[str, float] = field(default_factory=dict)
    kinds: tuple[str, ...] = ()
    gain: OtherGain | None = None
    set_in: bool = False
    outside: float = 0.0

    @property
    def changes(self) -> tuple[str, ...]:
        """How the refined model differs from the given one; empty where it stays as given."""
        return changes(self.given, self.model)


def changes(given: StageModel, refined: StageModel) -> tuple[str, ...]:
    """Return how a refined model differs from the one that it came from; empty if not at all."""
    texts = []
    # a play without weight is none
    old, new = (m.hysteresis.without_idle().numbers for m in (given, refined))
    if not np.array_equal(old, new):
        texts.append('H refitted')
    if given.scaling != refined.scaling:
        texts.append('offset refitted')
    if given.delay != refined.delay:
        texts.append('another delay')
    G, other = given.dynamics, refined.dynamics
    if not (np.array_equal(G.a, other.a) and np.array_equal(G.b, other.b)):
        texts.append('G retuned')
    before = {e.name: _frozen(e.parameters) for e in given.effects}
    after = {e.name: _frozen(e.parameters) for e in refined.effects}
    texts += [_with(e) for e in refined.effects if e.name not in before]
    texts += [f'{name} refitted' for name in after if before.get(name, after[name]) != after[name]]
    return (*texts, *(f'without {name}' for name in sorted(set(before) - set(after))))


def _with(added: EffectSetting) -> str:
    idle = find_effect(added.name).is_neutral(added.parameters)
    return f'with {added.name}{", switched off" if idle else ""}'


def _frozen(values: Mapping[str, object]) -> list[tuple[str, str]]:
    return sorted((k, repr(np.asarray(x).tolist())) for k, x in values.items())
