# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Compare the prediction of one axis with its displacement: residual, estimate and live errors."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.fitting.adaptation import Recalled
from piezo_ident.live.corrector import Corrector, Estimated
from piezo_ident.live.monitor import LiveError, Matched, Matcher
from piezo_ident.model.metrics import expected_error, percent
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.blocks import Samples

#: least share of the predictions of a second that meet a displacement, and number of seconds
#: that may stay below this share, as the incomplete first second of a stream
MET, PATIENCE = 0.5, 1


class AxisComparison:
    """
    Residual, estimate and live errors of one axis.

    Parameters
    ----------
    window : float
        Time over which the live errors are taken [s].
    corrector : Corrector
    publish : callable
        Gets the name of a quantity, ``residual`` or ``estimate``, and a block of this quantity.
    tell : callable
        Gets the corrections of the estimate by their names.
    note : callable
        Gets a doubt about the readings as text.
    knows : callable
        Returns whether the run of the model knows the memory of its plays.

    Attributes
    ----------
    error, left : LiveError
        Live errors of the prediction and of the estimate.
    again : int
        Repeated or late samples of displacement in the last second.
    room : float or None
        Distance of the voltage of the last second from the ends of the range of the model [V].
    """

    def __init__(
        self,
        window: float,
        corrector: Corrector,
        publish: Callable[[str, Samples], None],
        tell: Callable[[dict[str, float]], None],
        knows: Callable[[], bool],
        note: Callable[[str], None],
    ) -> None:
        self.corrector, self._knows, self._note, self._doubt = corrector, knows, note, ''
        self._publish, self._tell = publish, tell
        self.matcher, self._estimates = Matcher(), Matcher()
        self.error, self.left = LiveError(window), LiveError(window)
        self.model: StageModel | None = None
        # samples of the last second; number of seconds with too few comparisons
        self._predicted, self._measured, self._compared, self._unmet = 0, 0, 0, 0
        self.again = self._late = 0
        self.room: float | None = None
        self._ends = (np.inf, -np.inf)

    def set_model(self, model: StageModel, recalled: Recalled = StageModel.stream) -> None:
        """Take another model; `recalled` as for `Corrector.set_model`."""
        self.corrector.set_model(model, recalled)
        self.model = model
        self.clear()

    def clear(self) -> None:
        """Forget the live errors."""
        self.error.clear()
        self.left.clear()

    @property
    def is_known(self) -> bool:
        """Whether the memory of the plays is known, from rest or from sweeps."""
        return self._knows() or self.corrector.knows_memory

    def drove(self, v: Array) -> None:
        """Take the next voltages [V], shape (n,), of which `look` makes `room`."""
        numbers, (low, high) = v[np.isfinite(v)], self._ends
        self._ends = float(numbers.min(initial=low)), float(numbers.max(initial=high))

    def predicted(
        self, prediction: Samples, voltage: Samples, known: bool, felt: Array | float = 0.0
    ) -> None:
        """Take a prediction; see `Corrector.predicted`."""
        self._predicted += prediction.t.size
        # the corrector takes no displacement before the first prediction of its run
        self._correct(self.corrector.predicted(prediction, voltage, known, felt))
        self._compare(self.matcher.predicted(prediction))

    def measured(self, samples: Samples) -> None:
        """Take a block of displacement."""
        self._measured += samples.t.size
        if self.model is not None:
            self._left_by(self._estimates.measured(samples))
            self._compare(self.matcher.measured(samples))

    def _compare(self, pairs: list[Matched]) -> None:
        stroke = abs(self.model.scaling.Y) if self.model else float('inf')
        for pair in pairs:
            residual = pair.residual
            self._compared += residual.t.size
            self._publish('residual', residual)
            if self.is_known:
                self.error.add(residual.t, residual.values, stroke, pair.y)
            self._correct(self.corrector.measured(pair.t, pair.y))

    def _correct(self, several: list[Estimated]) -> None:
        for one in several:
            self._publish('estimate', one.samples)
            for told in one.corrections:
                self._tell(told)
            if one.is_settled:
                self._left_by(self._estimates.predicted(one.samples))
        if several and (doubt := self.corrector.doubt) != self._doubt:
            self._doubt = doubt
            if doubt:
                self._note(f'reading or zero of the displacement: {doubt}')

    def _left_by(self, pairs: list[Matched]) -> None:
        for pair in pairs:
            left = pair.residual
            self.left.add(left.t, left.values, self.corrector.span, pair.y)

    def look(self, is_silent: bool) -> str:
        """
        End a second; return the reason why its predictions cannot be compared, or ''.

        `is_silent` says that voltage came without a prediction.
        """
        (low, high), self._ends, self.room = self._ends, (np.inf, -np.inf), None
        if self.model is not None and low <= high:
            least, most = self.model.scaling.range
            self.room = min(low - least, most - high)
        predicted, measured, compared = self._predicted, self._measured, self._compared
        self._predicted = self._measured = self._compared = 0
        self.again, self._late = self.matcher.late - self._late, self.matcher.late
        if is_silent:
            # the voltage is at fault, not the displacement
            self.clear()
            return ''
        self._unmet = self._unmet + 1 if compared < MET * predicted else 0
        if self._unmet <= PATIENCE:
            return ''
        self.clear()
        if not measured:
            return 'no displacement comes'
        share = 100.0 * compared / predicted
        return f'{share:.0f} % of the voltage is met by displacement of the same t'

    @property
    def percent(self) -> float:
        """Live error of the prediction [% of stroke]; NaN before it is known."""
        return percent(self.error.rms, abs(self.model.scaling.Y)) if self.model else float('nan')

    def verdict(self, ratio: float) -> tuple[str, str]:
        """
        Return a reason to identify again and '', or '' and the corrections; both may be empty.

        `ratio` is the live error over the error at identification from which to identify again.
        """
        model = self.model
        before = None if model is None else expected_error(model)
        if model is None or before is None or self.left.seconds < 0.5 * self.left.window:
            return '', ''
        span = abs(model.scaling.Y)
        left = percent(np.fmin(self.left.rms, self.error.rms), span)
        if left > ratio * before:
            said = f'{left:.3g} % of stroke, {left / before:.1f} times that at identification'
            if changed := self.corrector.changed:
                said += f'; what changed: {changed}'
            return f'identify again, or diagnose on this motion: the live error is {said}', ''
        if self.error.seconds and self.percent > ratio * before:
            return '', f'corrected: {self.corrector.corrected}'
        return '', ''

    def problems(self, publishers: Collection[str]) -> list[str]:
        """
        List the faults of readings and voltage in the last second.

        `publishers` are the names of the nodes that publish the displacement.
        """
        faults = [self.left_out]
        if self.again:
            about = 'samples of displacement came again or out of turn: do two nodes publish it?'
            names = f' {" and ".join(sorted(publishers))} do' if len(publishers) > 1 else ''
            faults.append(f'{self.again} {about}{names}')
        span = 0.0 if self.model is None else float(np.ptp(self.model.scaling.range))
        if self.room is not None and self.room < -1e-3 * span:
            faults.append(f'the voltage leaves the identified range by {-self.room:.3g} V')
        return [text for text in faults if text]

    @property
    def left_out(self) -> str:
        """Text on the number of wild readings that the live error leaves out, or ''."""
        n = self.error.outliers
        return f'{n} wild readings of displacement are left out of the live error' if n else ''

    def figures(self) -> dict[str, object]:
        """List the live errors and the corrections, for /diagnostics."""
        left = percent(self.left.rms, self.corrector.span)
        return {
            'memory_known': self.is_known,
            'residual_rms': f'{self.error.rms:.6g}',
            'residual_percent': f'{self.percent:.4g}',
            'residual_mean': f'{self.error.mean:.6g}',
            'outliers': self.error.outliers,
            'estimate_rms': f'{self.left.rms:.6g}',
            'estimate_percent': f'{left:.4g}',
            **{name: f'{x:.6g}' for name, x in self.corrector.told.items()},
            **({} if self.room is None else {'head_room': f'{self.room:.6g}'}),
        }


def finite_readings(samples: Samples) -> Samples:
    """Return a block without its NaN and infinite samples."""
    usable = np.isfinite(samples.values)
    if usable.all():
        return samples
    return replace(samples, t=samples.t[usable], values=samples.values[usable])
