# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Rows of a record: from where on they count, behind a start that is not known."""

from dataclasses import replace

import numpy as np
from piezo_ident.diagnosis.rows import make_rows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import State
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.operators.play import initial_memory
from piezo_ident.record.record import Record

FS = 20_000


def test_rows_count_once_the_voltage_has_swept_most_of_its_range():
    model = SimulatedStage.load('paper').model
    t = np.arange(FS) / FS
    # up to 10 V and down to 4.5 V, which nobody recorded
    before = np.concatenate([np.linspace(0, 10, FS), np.linspace(10, 4.5, FS)])
    # 85 % of the range, up first, and all of it
    part, whole = 4.5 + 4.25 * np.sin(8 * np.pi * t), 4.5 + 4.5 * np.sin(8 * np.pi * t)
    v = np.concatenate([before, part, whole, 4.5 + 5.5 * np.sin(2 * np.pi * t[: FS // 4])])
    y = model.simulate(v)
    n = before.size
    rows = make_rows(model, [Record.from_arrays(v[n:], y[n:], sample_rate=FS)])
    first = int(np.argmax(rows.keep[0])) * rows.m / FS
    # from the lowest turn of the first sine on, not from where the last sine tops all
    assert 0.12 < first < 0.2

    def missed(rows):
        state = State(model.hysteresis, np.zeros(1))
        return rows.percent(float(np.mean((rows.x - Simulator(model, rows).run(state)) ** 2)))

    u0 = float(rows.runs[0].u[0])
    as_at_rest = replace(rows, memories=(lambda r: initial_memory(u0, r),))
    # the wide plays stand where they were found
    assert missed(rows) < 1e-6 < 0.005 < missed(as_at_rest)


def test_no_kind_holds_most_of_what_is_judged_where_most_of_a_record_rests():
    model = SimulatedStage.load('paper').model
    t = np.arange(FS) / FS
    # six seconds of rest in the middle of the range, of which the memory is not known
    v = np.concatenate([np.full(6 * FS, 5.0), 5.0 + 5.0 * np.sin(4 * np.pi * t)])
    y = model.simulate(np.concatenate([np.linspace(0, 8, FS), np.linspace(8, 5, FS), v]))
    rows = make_rows(model, [Record.from_arrays(v, y[2 * FS :], sample_rate=FS, name='late')])
    assert not rows.kinds
    counts = np.bincount(rows.group[rows.block])
    assert counts.size > 3 and counts.max() < 0.4 * counts.sum()
