# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The next experiment: what is open is asked for once, by the motion that would decide it."""

from dataclasses import replace

from diagnosis_examples import example, measured
import numpy as np
from piezo_ident.diagnosis.next_experiment import next_experiment
from piezo_ident.diagnosis.results import FoundEffect, Untestable
from piezo_ident.excitation.program import parse_program, Program
from piezo_ident.record.record import Piece, Record
import pytest

RATE = 2000.0


def played(*segments: str, slew: float = 40.0) -> Record:
    """Return what a program would record."""
    text = '\n'.join([f'{{limits: [0, 10], slew: {slew}, segments: [', ',\n'.join(segments), ']}'])
    sequence = parse_program(text).build(RATE)
    piece = Piece(sequence.v, np.zeros(sequence.n), RATE, segments=sequence.segments)
    return Record((piece,))


def shipped(name: str) -> Record:
    """Return what a shipped program would record."""
    sequence = Program.load(name).build(RATE)
    piece = Piece(sequence.v, np.zeros(sequence.n), RATE, segments=sequence.segments)
    return Record((piece,), name)


def named(name: str):
    """Return a diagnosis that found one effect, and could test all."""
    effect = FoundEffect(name, 'hidden', 0.99, 0.3, {})
    return replace(example('named'), effects=(effect,), untestable=())


HOLD = '{signal: hold, level: 5, duration: 2}'
SINE = '{signal: sine, bias: 5, amplitude: 5, frequency: 1, periods: 2}'
LARGE = '{signal: sine, name: 80Hz-large, bias: 5, amplitude: 4, frequency: 80, duration: 0.1}'
SMALL = '{signal: sine, name: 80Hz-small, bias: 5, amplitude: 1, frequency: 80, duration: 0.1}'


def test_without_data_it_is_sweeps_and_then_nothing_nor_is_it_where_nothing_is_missing():
    assert next_experiment(None).kind == 'sweeps'
    assert next_experiment(None, asked=('sweeps',)) is None
    assert next_experiment(replace(example('none'), untestable=()), [played(SINE)]) is None


@pytest.mark.parametrize('effect', ['creep', 'rate_dependent_hysteresis', 'thermal_drift'])
def test_a_slow_effect_without_a_hold_asks_for_holds(effect):
    wanted = next_experiment(named(effect), [shipped('diagnosis')])
    assert wanted.kind == 'holds'
    assert wanted.reason.startswith(effect) and 'a hold of at least 2 s' in wanted.reason
    records = [shipped('diagnosis'), shipped('holds')]
    assert next_experiment(named(effect), records) is None


def test_a_class_asks_for_what_parts_its_members():
    found = replace(example('class'), untestable=())
    wanted = next_experiment(found, [measured()])
    assert wanted.kind == 'holds'
    for name in found.group.names:
        assert name in wanted.reason


def test_what_could_not_be_tested_asks_last_and_what_nothing_would_show_does_not():
    found = replace(
        example('none'),
        untestable=(Untestable('cross_coupling', 'x'), Untestable('preload_loss', 'x')),
    )
    wanted = next_experiment(found, [played(SINE, LARGE)])
    assert wanted.kind == 'sweeps'
    assert wanted.reason.startswith('preload_loss cannot be tested without equal minor loops')
    only = replace(found, untestable=found.untestable[:1])
    assert next_experiment(only, [played(SINE)]) is None


def test_something_unexplained_asks_for_all_motions_one_after_the_other():
    found = replace(example('unexplained'), untestable=())
    asked, records = [], [played(SINE)]
    while (wanted := next_experiment(found, records, asked)) is not None:
        assert wanted.kind not in asked
        asked.append(wanted.kind)
        records.append(shipped('diagnosis' if wanted.kind == 'sweeps' else 'holds'))
    assert sorted(asked) == ['holds', 'sweeps']


def test_what_was_asked_for_in_vain_is_not_asked_again():
    found = named('rate_dependent_hysteresis')
    first = next_experiment(found, [played(SINE)])
    second = next_experiment(found, [played(SINE)], [first.kind])
    assert first.kind == 'holds' and second.kind == 'sweeps'
    assert next_experiment(found, [played(SINE)], ['holds', 'sweeps']) is None


@pytest.mark.parametrize(
    ('segments', 'slew', 'is_enough'),
    [
        ((HOLD,), 40.0, True),
        (('{signal: hold, level: 5, duration: 1.5}',), 40.0, False),
        # a step of a twentieth of the range shows no creep, nor does one that takes seconds
        (('{signal: hold, level: 0.5, duration: 3}',), 40.0, False),
        ((HOLD,), 2.0, False),
        # the mean of a fast sine stands still, the sine does not
        (('{signal: sine, bias: 5, amplitude: 5, frequency: 100, duration: 3}',), 40.0, False),
        (('{signal: staircase, levels: [0, 5], hold: [0.1, 2.5]}',), 40.0, True),
    ],
)
def test_what_counts_as_a_hold(segments, slew, is_enough):
    rest = [LARGE, SMALL, SINE, '{signal: idle, duration: 1}', SINE]
    record = played('{signal: idle, duration: 0.2}', *segments, slew=slew)
    wanted = next_experiment(named('creep'), [record, played(*rest)])
    assert (wanted is None) == is_enough
    # the same without labels
    (piece,) = record
    bare = Record((replace(piece, segments=()),))
    wanted = next_experiment(named('creep'), [bare, played(*rest)])
    assert (wanted is None) == is_enough


@pytest.mark.parametrize(
    ('segments', 'missing'),
    [
        ((SINE, LARGE, SMALL), ''),
        ((SINE, LARGE), 'one fast sine at two amplitudes'),
        ((LARGE, SMALL), 'a slow sweep over the full range'),
        ((SINE, SMALL, '{signal: multisine, bias: 5, amplitude: 4, lowest: 1, highest: 50, '
          'period: 1, periods: 2}'), 'one fast sine at two amplitudes'),
    ],
)  # fmt: skip
def test_what_rate_dependence_needs(segments, missing):
    wanted = next_experiment(named('rate_dependent_hysteresis'), [played(HOLD), played(*segments)])
    relevant = ('one fast sine at two amplitudes', 'a slow sweep over the full range')
    said = wanted.reason if wanted else ''
    assert missing in said
    assert bool(missing) == any(name in said for name in relevant)
