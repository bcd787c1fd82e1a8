# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The stage behind the published errors: its laws and numbers are fixed in table_one.yaml."""

from __future__ import annotations

from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any
import zlib

import numpy as np
from numpy.typing import ArrayLike
import yaml

from .cores import Array, plays, Row
from .laws import velocity
from .linear import ARX, delayed, RATE, relaxation
from .stage import SPAN, VOLTS

#: Table I of Gu, Li, Zhu, Su (2016), doi:10.1109/TMECH.2015.2465868: error of the model with
#: dynamics [% of stroke] at each frequency of v = 5 + 5 sin(2 pi f t) [Hz]
PUBLISHED = {1: 1.03, 10: 1.75, 50: 2.73, 80: 3.15, 100: 3.23, 120: 3.59}

PARAMETERS = Path(__file__).resolve().parents[1] / 'table_one.yaml'


@dataclass(frozen=True)
class TableOneStage:
    """
    The published hysteresis and dynamics with plays that widen with speed, and with creep.

    `parameters`: as in table_one.yaml; `seed`: of the noise.
    """

    parameters: dict[str, Any]
    seed: int = 0

    def respond(
        self, t: ArrayLike, v: ArrayLike, changed: bool = True, *, clean: bool = False
    ) -> Array:
        """
        Return the measured displacement [m], shape (n,), of a stage that was at rest at 0 V.

        `t`: [s], uniform, at 20 kHz; `v`: [V]; `changed`: no difference: what is undeclared was
        always there; `clean`: without sensor noise.
        """
        time, volts = (np.ascontiguousarray(x, dtype=np.float64) for x in (t, v))
        if abs((time[-1] - time[0]) * RATE / (time.size - 1) - 1) > 1e-6:
            raise ValueError('the published dynamics are at 20 kHz; sample at 20 kHz')
        core, rate, creep = (self.parameters[k] for k in ('hysteresis', 'rate', 'creep'))
        u = volts / VOLTS
        row = Row(np.array(core['thresholds']), np.array(core['weights']))
        speed = np.abs(velocity(u, rate['corner']))
        # an arc tangent, which is none of the candidate's laws
        wider = rate['gain'] * 2.0 / np.pi * np.arctan(speed / rate['speed'])
        h = u * (core['p2'] + core['p1'] * u * u) + plays(u, row, wider, additive=True)
        # the published dynamics have this static gain; here they have 1
        h = relaxation(self.parameters['static_gain'] * h, creep['law'], creep['gain'])
        y = delayed(ARX()(h), self.parameters['delay'] / RATE)
        if not clean:
            key = [11, self.seed, zlib.crc32(volts.tobytes())]
            rng = np.random.default_rng(key)
            y = y + self.parameters['noise_rms'] * rng.standard_normal(y.size)
        return np.asarray(y * SPAN)


def table_one_stage(seed: int = 0, **changes: dict[str, float]) -> TableOneStage:
    """
    Return the stage of table_one.yaml.

    `seed`: of the noise; `**changes`: entries of `rate` and `creep` to replace.
    """
    data = yaml.safe_load(PARAMETERS.read_text(encoding='utf-8'))
    for name, values in changes.items():
        data[name] = {**data[name], **values}
    for name in ('rate', 'creep'):
        for key, value in data[name].items():
            if not isinstance(value, str) and not math.isfinite(value):
                raise ValueError(f'{PARAMETERS.name}: {name}.{key} must be finite, got {value}')
    return TableOneStage(data, seed)
