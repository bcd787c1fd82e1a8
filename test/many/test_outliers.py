# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Of many records those that stand out are named, and the spread of the others is none."""

from types import SimpleNamespace

import numpy as np
from piezo_ident.cli.each_command import _print
from piezo_ident.many.outliers import stand_out
from piezo_ident.many.table import Row


def line(count: int = 40) -> list[Row]:
    """Stages of one product: gain 5 %, mode 4 %, errors and noise by a factor of two."""
    rng = np.random.default_rng(1)
    return [
        Row(
            f'stage_{i}',
            {
                'sample_rate': 10e3,
                'stroke': 80e-6,
                'gain': 5e-7 * (1 + 0.05 * rng.uniform(-1, 1)),
                'resonance': 640.0 * (1 + 0.04 * rng.uniform(-1, 1)),
                'delay_samples': 3 + i % 2 * (i > 35),
                'error_held_out': 0.3 * np.exp(0.4 * rng.normal()),
                'noise_floor': 0.007 * np.exp(0.4 * rng.normal()),
            },
        )
        for i in range(1, count + 1)
    ]


def test_the_spread_of_a_product_stands_not_out():
    assert stand_out(line()) == {}


def test_what_differs_is_named_with_its_column(capsys):
    rows = line()
    odd = {
        4: {'gain': 4e-7, 'resonance': 500.0},
        8: {'gain': -5e-7},
        17: {'noise_floor': 0.11, 'error_held_out': 0.03},
        26: {'error_held_out': 4.0, 'resonance': None},
        29: {'sample_rate': 5e3, 'delay_samples': 7},
    }
    for i, values in odd.items():
        rows[i - 1] = Row(f'stage_{i}', {**rows[i - 1].values, **values})
    rows[0] = Row('stage_1', reason='a cable was loose')
    assert {name: set(columns) for name, columns in stand_out(rows).items()} == {
        'stage_4': {'gain', 'resonance'},
        'stage_8': {'gain'},
        'stage_17': {'noise_floor'},
        'stage_26': {'error_held_out'},
        'stage_29': {'sample_rate', 'delay_samples'},
    }
    _print(rows, rows[:1], SimpleNamespace(say=print))  # type: ignore[arg-type]
    said = capsys.readouterr().out
    assert '  stage_29: sample rate 5000 Hz (1e+04), delay samples 7 (3)' in said
    assert '  stage_4: gain 0.4 µm/V (0.' in said


def test_a_few_records_say_nothing():
    rows = line(7)
    rows[0] = Row('stage_1', {**rows[0].values, 'gain': 1e-7})
    assert stand_out(rows) == {}
