# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Stages of two axes on the live graph: chains with paths between them, and shared modes."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from axes_scanner import AXES, creeping, grown, moving, RATE
import numpy as np
import piezo_ident as pi
from piezo_ident.live.guard import GuardSettings
from piezo_ident.live.live_learning import LiveLearning
from piezo_ident.live.tracker import Tracker
from piezo_ident.model.modes.stream import ModesStream
from piezo_ident.model.multi_axis import SHARED_MODES
from piezo_ident.record.blocks import Samples
from random_models import random_modes_model


@dataclass(frozen=True)
class Kind:
    """A model, a stage whose second axis moves 3 % more, and what their node is told."""

    model: pi.MultiAxisModel
    stage: pi.MultiAxisModel
    limits: GuardSettings
    #: samples that the inverse looks ahead
    preview: int
    #: motions of both axes of so many samples [m]
    wanted: Callable[[int], np.ndarray]

    def tracker(self, follow='off', model=None, limits=None):
        return Tracker(model or self.model, limits or self.limits, self.preview, follow, AXES)

    def within_limits(self, v, limits=None):
        """Return whether voltages keep to the limits, and from sample to sample to the slew."""
        settings = limits or self.limits
        steps = np.abs(np.diff(v, axis=1)).max()
        return (
            settings.low <= v.min()
            and v.max() <= settings.high
            and steps <= settings.step * (1 + 1e-9)
        )


def chains():
    """Return chains with paths of which the first creeps."""
    limits, model = GuardSettings(0.0, 10.0, 40e3, 200.0, 0.0, RATE), creeping()
    return Kind(model, grown(model, 'y_b'), limits, 60, cosines)


def cosines(n):
    waves = np.stack([np.cos(2 * np.pi * f * np.arange(n) / RATE) for f in (3.0, 0.7)])
    return np.array([[20e-6], [15e-6]]) * (1.0 - 0.8 * waves)


def coupled(**options):
    """Return shared modes with plays."""
    model = random_modes_model(np.random.default_rng(2), strength=0.3, **options)
    modes = model.modes
    y0, top = (ModesStream(modes).process(np.full((1, 2), v))[0] for v in (0.0, 10.0))
    known = {SHARED_MODES: {'diagnosis': {'errors': {'after': 0.02, 'worst': 0.02}}}}
    axes = {
        axis: replace(x, scaling=replace(x.scaling, y0=low, Y=Y), identification=known)
        for (axis, x), low, Y in zip(model.axes.items(), y0, top - y0, strict=True)
    }
    more = np.array([[1.0], [1.03]])
    linear = replace(modes.linear, c=more * modes.linear.c, d=more * modes.linear.d)
    zero = y0 + more[:, 0] * (modes.y0 - y0)
    changed = replace(modes, linear=linear, h=more * modes.h, y0=zero)
    limits = GuardSettings(-1.0, 11.0, 40e3, 200.0, 0.0, 20e3)
    stages = pi.MultiAxisModel(axes, modes), pi.MultiAxisModel(axes, changed)
    return Kind(*stages, limits, 400, lambda n: waves_about_the_middle(modes, n))


def waves_about_the_middle(modes, n):
    """Return a fast and a slow motion about the middle of the stage."""
    rest, middle = (ModesStream(modes).process(x[None])[0] for x in (np.zeros(2), modes.v0))
    waves = np.stack([0.3 * np.sin(2 * np.pi * f * np.arange(n) / 20e3) for f in (40.0, 9.0)])
    return middle[:, None] + np.abs(middle - rest)[:, None] * waves


KINDS = {'chains': chains, 'modes': coupled}


def simulated(model, v, axes=AXES):
    """Return the offline prediction, a row for each axis."""
    y = model.simulate({f'v{axis[1:]}': row for axis, row in zip(axes, v, strict=True)})
    return np.stack([y[axis] for axis in axes])


def blocks(v, rate, size=70, start=0):
    t = (start + np.arange(v.shape[1])) / rate
    ends = range(0, t.size, size)
    return [Samples(t[k : k + size], np.ascontiguousarray(v[:, k : k + size])) for k in ends]


def predicted(predictor, v, rate, start=0, size=70):
    return np.hstack([predictor.process(x).values for x in blocks(v, rate, size, start)])


def noise(shape, seed=1):
    return 1.5e-9 * np.random.default_rng(seed).standard_normal(shape)


def tracked(kind, wanted, follow='off', size=100, stage=None, earlier=0.0):
    """Track motions on a stage; return the tracker, voltages, and errors [% of the span]."""
    tracker, run = kind.tracker(follow), moving(stage or kind.stage, earlier)
    parts, added = [], noise(wanted.shape)
    for k in range(0, wanted.shape[1], size):
        drive = tracker.process(wanted[:, k : k + size], k == 0)
        y = run.process(drive.v, drive.t)
        for i, row in enumerate(y + added[:, k : k + size]):
            tracker.measured(Samples(drive.t, row), i)
        parts.append((drive.v, y - drive.wanted))
    v, error = (np.hstack(rows) for rows in zip(*parts, strict=True))
    return tracker, v, 100.0 * error / np.ptp(wanted, axis=1)[:, None]


def repeated(kind, wanted, stage=None, most=6):
    """Repeat motions on a stage; return the learning, voltages, and errors by axis [%]."""
    learning, run = (
        LiveLearning(kind.model, wanted, kind.limits, AXES),
        moving(stage or kind.stage),
    )
    spans, sent, errors = np.ptp(wanted, axis=1), [], []
    while not learning.is_done and len(learning.errors) < most:
        tracker = kind.tracker()
        t, v = tracker.play(learning.voltage)
        y = run.process(v, t)
        for k, row in enumerate(y + noise(y.shape, len(sent))):
            learning.measured(Samples(t, row), 0, k)
        assert learning.is_complete
        learning.take()
        sent.append(v)
        rms = np.sqrt(np.mean((y[:, -wanted.shape[1] :] - wanted) ** 2, axis=1))
        errors.append(100.0 * rms / np.where(spans, spans, 1.0))
        run.process(*reversed(tracker.idle(3000)))
    return learning, sent, np.stack(errors)
