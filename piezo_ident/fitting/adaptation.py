# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Learn the gain of a running stage slowly, and on request its hysteresis.

The learnt displacement is the free run plus a sum of terms theta_j f_j.  Each f_j is the response
to one change of the model.  The model may change its gain, the weights of its plays (by hats:
triangles over the thresholds), its cubic, or its creep.  A changed model runs for each f_j, so
amplifier, creep, G and delay act on the change as they act on the stage.  If modes that axes share
predict, the gain alone is learnt, and f is the free run about the zero.  A high-pass removes
offset, drift and creep of earlier motion from the f_j and from the measured error; the observer
corrects these.

Recursive least squares fit theta to the means f of groups of samples.  Old information fades only
for the theta_j that a group informs about, and never below the information of the prior:

    L <- A L A + (1 - A^2) L0 + f f' / R,      A_j^2 = 1 - (1 - mu) s_j / (s_j + e R)

L is the information, L0 the diagonal information of the prior, R the variance of a measurement.
s_j is f_j^2 / L0_jj.  mu follows from `MEMORY`.  e is `TELLS` of the kernel.  A stage at rest
informs about no theta_j, so theta stays.  Half-spaces bound theta: the weights of plays stay
positive, H rises, and each change has a plausible size.  A theta outside of a half-space moves
onto it along L^-1.  Measurements far from the prediction are refused for `PATIENCE`, in which the
high-pass forgets a step of the sensor.  Later they mean another stage: L returns to the prior.

J. E. Parkum, N. K. Poulsen and J. Holst, "Recursive forgetting algorithms", Int. J. Control 55(1),
1992, doi:10.1080/00207179208934228.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.effects.creep import Creep
from piezo_ident.fitting import adaptation_kernel as kernel
from piezo_ident.model.metrics import expected_error
from piezo_ident.model.observer import GAIN_SIZE, GATE, HORIZON, LEAST, UNKNOWN
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import Stream
from piezo_ident.operators.hysteresis import Hysteresis

#: learnt part of the model
Learns = Literal['off', 'gain', 'hysteresis']
#: turns a model into a run that has seen the voltage so far.  The value is None if modes that axes
#: share predict instead of the model; the model then has scaling and known errors alone
Recalled: TypeAlias = Callable[[StageModel], Stream] | None

#: time over which samples are averaged to one measurement [s]
GROUP = 2e-3
#: time constant of the high-pass [s]: scans are faster, drift and slow creep are slower (taste)
SLOW = 0.1
#: time of motion after which a measurement counts by 1 / e [s].  A change shall be learnt within
#: 10 s, more than five of these times
MEMORY = 1.5
#: time of refused measurements after which they are believed [s]: the high-pass has forgotten a
#: step of the sensor by then
PATIENCE = 6.0 * SLOW
#: number of hats over the thresholds (taste: as many as the wider laws of H have)
HATS = 5
#: rms size of each change: of weights, of the cubic in normalised units, of the gains of creep
#: (taste: a third)
WEIGHTS, CUBIC, CREEP = 0.3, 0.1, 0.3
#: largest change, in these sizes (taste)
LARGEST = 3.0
#: smallest remaining share of a weight of a play, and of the slope of H (taste)
LEFT = 0.1
#: number of places over the span at which the slope of H is bounded
PLACES = 9
#: size of a drift behind the high-pass, in spans.  A drift of 1e-2 spans per second is creep of a
#: hundredth per decade, half a second after a step over the range
DRIFT = SLOW * 1e-2


@dataclass(frozen=True, eq=False)
class Change:
    """A change of a model by one unit: its name, the changed model, and its rms size."""

    name: str
    model: StageModel
    size: float


def _changes(model: StageModel, kind: Learns) -> Iterator[Change]:
    h = model.hysteresis
    yield Change('gain', replace(model, hysteresis=h.scaled(2.0)), GAIN_SIZE)
    if kind != 'hysteresis':
        return
    r = h.thresholds
    if r.size:
        nodes = np.linspace(r[0], r[-1], min(HATS, r.size))
        for k, hat in enumerate(np.eye(nodes.size)):
            share = np.interp(r, nodes, hat) if nodes.size > 1 else np.ones(1)
            yield Change(f'weights_{k}', replace(model, hysteresis=grown(h, share)), WEIGHTS)
    yield Change('cubic', replace(model, hysteresis=replace(h, p1=h.p1 + 1.0)), CUBIC)
    if any(e.name == Creep.name for e in model.effects):
        yield Change('creep', _creeping(model, 2.0), CREEP)


def grown(h: Hysteresis, share: Array) -> Hysteresis:
    """Increase the weights of the plays of H by a share each, with their curves and bias."""
    more = 1.0 + share
    return replace(
        h,
        weights=h.weights * more,
        curves=None if h.curves is None else h.curves * more[:, None],
        bias=None if h.bias is None else h.bias * more,
    )


def _creeping(model: StageModel, times: float) -> StageModel:
    """Multiply the creep of a model by a factor."""
    effects = []
    for effect in model.effects:
        if effect.name == Creep.name:
            gain = (times * np.asarray(effect.parameters['gain'])).tolist()
            effect = replace(effect, parameters={**effect.parameters, 'gain': gain})
        effects.append(effect)
    return replace(model, effects=tuple(effects))


def check_learns(kind: Learns, shares: bool) -> None:
    """Refuse hysteresis of modes that axes share with a ModelError."""
    if shares and kind == 'hysteresis':
        raise ModelError(
            'adapt: the hysteresis of modes that the axes share is not learnt, because each play '
            "moves all axes and an axis learns from its own displacement; set adapt to 'gain'"
        )


class Adaptation:
    """
    Learns changes of a model from displacement that comes a horizon later.

    The result does not depend on the size of the blocks.

    Parameters
    ----------
    model : StageModel
    kind : {'gain', 'hysteresis'}
        Learnt part of the model; the hysteresis includes the gain.
    horizon : int, optional
        Samples by which displacement is older than the free run that it corrects.
    recalled : callable, optional
        See `Recalled`; at rest when absent.
    """

    def __init__(
        self,
        model: StageModel,
        kind: Learns,
        horizon: int = HORIZON,
        recalled: Recalled = StageModel.stream,
    ) -> None:
        check_learns(kind, recalled is None)
        self.model, self.kind, self.horizon = model, kind, horizon
        percent = expected_error(model)
        held = UNKNOWN if percent is None else percent / 100.0
        self._changes = list(_changes(model, kind))
        self._group = max(1, round(GROUP * model.sample_rate))
        groups = [max(1.0, t * model.sample_rate / self._group) for t in (MEMORY, PATIENCE)]
        size = max(held, LEAST)
        sizes = np.array([change.size for change in self._changes])
        keep = np.exp(-1.0 / (SLOW * model.sample_rate))
        self._law = np.array([size**2, keep, np.exp(-1.0 / groups[0]), groups[1], GATE**2])
        # the last unknown is a drift
        self._prior = np.diag(np.append(sizes, DRIFT) ** -2.0)
        rows = self._half_spaces(sizes)
        self._halves = np.insert(rows, sizes.size, 0.0, axis=1)
        self.restore()
        self.begin(recalled)

    def _half_spaces(self, sizes: Array) -> Array:
        """Return the bounds of theta as rows of a and b: a theta >= b."""
        h, n = self.model.hysteresis, sizes.size
        names = [change.name for change in self._changes]
        least = -LARGEST * sizes
        weights = np.array([float(name.startswith('weights')) for name in names])
        gain = np.array([float(name == 'gain') for name in names])
        rows = [*np.column_stack([np.eye(n), least]), *np.column_stack([-np.eye(n), least])]
        # a weight of a play grows by the gain and by its hat
        rows += [np.append(np.eye(n)[k] + gain, LEFT - 1.0) for k in np.flatnonzero(weights)]
        v = np.linspace(*h.span, PLACES)
        before = h.slope_at_turns(v)
        grown = [c.model.hysteresis.slope_at_turns(v) - before for c in self._changes]
        for k in np.flatnonzero(before > 0.0):
            rows.append(np.append([g[k] for g in grown], (LEFT - 1.0) * before[k]))
        return np.array(rows)

    def restore(self) -> None:
        """Return to the model without learnt changes."""
        self._theta = np.zeros(len(self._changes) + 1)
        self._information, self._now = self._prior.copy(), np.zeros(kernel.PLACES)
        self._now[kernel.SCALE] = 1.0
        self._sums = np.zeros(len(self._changes) + 1)

    def begin(self, recalled: Recalled = StageModel.stream) -> None:
        """Begin another run with the learnt changes."""
        n = len(self._changes) + 1
        self._runs = None if recalled is None else [recalled(x.model) for x in self._changes]
        self._past = np.full((n, self.horizon), np.nan)
        self._slow, self._sums = np.full(n, np.nan), np.zeros(n)
        self._now[[kernel.COUNT, kernel.FINITE, kernel.REFUSED, kernel.PIVOT]] = 0.0

    @property
    def seconds(self) -> float:
        """Time of motion that the model has learnt from [s]."""
        return float(self._now[kernel.LEARNT]) * self._group / self.model.sample_rate

    @property
    def learnt(self) -> dict[str, tuple[float, float]]:
        """Learnt changes by name, each with its standard deviation."""
        std = np.sqrt(np.diag(np.linalg.inv(self._information)))
        rows = zip(self._changes, self._theta.tolist(), std.tolist(), strict=False)
        return {change.name: (value, s) for change, value, s in rows}

    @property
    def told(self) -> dict[str, float]:
        """Relative changes of the gain and of the width of the loop."""
        learnt = {name: x for name, (x, _) in self.learnt.items()}
        share, q = self._weights(learnt), self.model.hysteresis.weights
        found = {'learnt/gain': learnt['gain']}
        if share is not None and q.any():
            found['learnt/loop'] = learnt['gain'] + float(q @ share / q.sum())
        return found

    def _weights(self, learnt: dict[str, float]) -> Array | None:
        """Return the relative change of each weight of a play, without the change of the gain."""
        hats = [x for name, x in learnt.items() if name.startswith('weights')]
        r = self.model.hysteresis.thresholds
        return np.interp(r, np.linspace(r[0], r[-1], len(hats)), hats) if hats else None

    @property
    def learnt_model(self) -> StageModel:
        """The learnt model, with an entry of the changes in its identification."""
        model, changes = self.model, {name: x for name, (x, _) in self.learnt.items()}
        gain, h = 1.0 + changes['gain'], model.hysteresis
        share = self._weights(changes)
        if share is not None:
            h = grown(h, share / gain)
        h = h.scaled(gain)
        h = replace(h, p1=h.p1 + changes.get('cubic', 0.0))
        if 'creep' in changes:
            model = _creeping(model, 1.0 + changes['creep'])
        entry = {
            'adapt': self.kind,
            'seconds': round(self.seconds, 3),
            **{name: {'value': x, 'std': std} for name, (x, std) in self.learnt.items()},
        }
        before = model.identification.get('adaptation') or []
        found = {**model.identification, 'adaptation': [*before, entry]}
        return replace(model, hysteresis=h, identification=found)

    def process(
        self, v: Array, t: Array, free: Array, measured: Array, sound: bool = True
    ) -> Array:
        """
        Run the learnt model freely over the next samples [m], shape (n,).

        Parameters
        ----------
        v, t : ndarray, shape (n,)
            Voltage [V] and its time [s].
        free : ndarray, shape (n,)
            Free run of the model without changes [m].
        measured : ndarray, shape (n,)
            Displacement `horizon` samples before each sample [m]; NaN if it is missing.
        sound : bool, optional
            Whether to learn from these samples; False while outputs of plays are unknown.
        """
        s = self.model.scaling
        new = self.responses(v, t, free)
        whole = np.concatenate([self._past, new], axis=1)
        before, self._past = whole[:, : v.size].copy(), whole[:, v.size :].copy()
        y = s.x(measured) if sound else np.full(v.size, np.nan)
        return np.asarray(free + s.Y * self.learn(y, before, new))

    def responses(self, v: Array, t: Array, free: Array) -> Array:
        """Run each changed model; return the free run and the responses to unit changes."""
        s = self.model.scaling
        if self._runs is None:
            return np.stack([s.x(free)] * 2)
        return np.stack([s.x(free), *[(run.process(v, t) - free) / s.Y for run in self._runs]])

    def learn(self, y: Array, before: Array, new: Array) -> Array:
        """
        Learn from normalised displacement; return the learnt correction of the free run.

        The rows of `before` and `new` are the free run and the responses, a horizon before and
        now; shapes (k, n).
        """
        out = np.empty(y.size)
        kernel.learn(
            y,
            before,
            new,
            self._law,
            self._prior,
            self._halves,
            self._theta,
            self._information,
            self._slow,
            self._sums,
            self._now,
            self._group,
            out,
        )
        return out
