# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Give a model its methods for users: predict, score, inverse, parameters, bode, to_tf, save."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
import os
from typing import Any, NamedTuple, TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.files import write_text
from piezo_ident.effects import find_effect

if TYPE_CHECKING:
    from control import TransferFunction
    from piezo_ident import EachAxis, FreeRun, Inverse, MultiAxisInverse
    from piezo_ident.model.free_run import FreeRunErrors
    from piezo_ident.record.record import Record

#: frequencies of a Bode diagram, and the lowest as a share of the highest; taste
POINTS, LOWEST = 400, 1e-3


@dataclass(frozen=True)
class ModelParameter:
    """
    One parameter of a model.

    Attributes
    ----------
    part : str
        H, G, delay, or the name of an effect.
    name, unit : str
        Symbol of the paper, or name of the parameter of an effect.  An effect has the units of the
        normalised chain, in which 1 is the full span.
    value : float or str
    std : float or None
        Standard deviation of its fit, with the dependence on all other parameters if the model
        holds it (`piezo_ident.uncertainty.parameters`); None if unknown.
    """

    part: str
    name: str
    value: float | str
    unit: str
    std: float | None = None

    @property
    def is_known(self) -> bool | None:
        """Whether the deviation is smaller than the value; None without a number or deviation."""
        if self.std is None or isinstance(self.value, str):
            return None
        return self.std < abs(self.value)


class Parameters(tuple[ModelParameter, ...]):
    """Parameters of a model; a prompt shows them as one table."""

    def __repr__(self) -> str:
        import piezo_ident as pi

        number = pi.report.number
        rows = [
            (
                *(p.part, p.name),
                p.value if isinstance(p.value, str) else number(p.value, 4),
                *(number(p.std, 2), p.unit),
            )
            for p in self
        ]
        head = ('part', 'name', 'value', 'deviation', 'unit')
        text: str = pi.report.plain_text([pi.report.Table('', head, rows)])
        return text


class Bode(NamedTuple):
    """Frequency [Hz], gain [m/V] and phase [deg], shape (n,) each."""

    frequency: Array
    gain: Array
    phase: Array


class FrontDoor:
    """Base class of `StageModel`; a method imports the later room that does its work."""

    def predict(self: Any, record: Record, interval: float | None = None) -> FreeRun:
        """
        Predict a measured record in free run, with a band on request; `piezo_ident.free_run`.

        Examples
        --------
        >>> import piezo_ident as pi
        >>> stage = pi.SimulatedStage.load('paper')
        >>> stage.model.predict(stage.play(pi.Program.load('minor_loops'))).predicted.size
        218000
        """
        from piezo_ident import free_run

        run: FreeRun = free_run(self, record, interval)
        return run

    def score(self: Any, record: Record) -> FreeRunErrors:
        """
        Rate the free run on a measured record by its error [% of stroke] and its NRMSE fit [%].

        Samples before the end of an estimated start do not count.

        Examples
        --------
        >>> import piezo_ident as pi
        >>> stage = pi.SimulatedStage.load('paper')
        >>> score = stage.model.score(stage.play(pi.Program.load('minor_loops')))
        >>> score.percent < 0.01, score.fit > 99.9
        (True, True)
        """
        run = self.predict(record)
        errors: FreeRunErrors = run.errors_after_start or run.errors
        return errors

    def inverse(self: Any, wanted: ArrayLike, **options: Any) -> Inverse:
        """
        Find the voltage that moves the model along a wanted displacement; `piezo_ident.invert`.

        Examples
        --------
        >>> import numpy as np
        >>> import piezo_ident as pi
        >>> model = pi.SimulatedStage.load('paper').model
        >>> wanted = 20e-6 * (1.5 - np.cos(np.arange(2000) / 100))
        >>> drive = model.inverse(wanted)
        >>> y = model.simulate(drive.v)[drive.lead :]
        >>> bool(np.abs(y - wanted).max() < 1e-7)
        True
        """
        from piezo_ident import invert

        return invert(self, wanted, **options)

    @property
    def quantities(self: Any) -> tuple[ModelParameter, ...]:
        """List gain and phase of G, modes, static gain and loop widths, with their deviations."""
        told = self.identification.get('quantities', ())
        keys = {'part', 'name', 'value', 'unit', 'std'}
        rows = told if isinstance(told, Sequence) and not isinstance(told, str) else ()
        return tuple(
            ModelParameter(**row) for row in rows if isinstance(row, dict) and set(row) == keys
        )

    @property
    def parameters(self: Any) -> Parameters:
        """
        List all parameters with their standard deviations, then `quantities`; printed as a table.

        Examples
        --------
        >>> import piezo_ident as pi
        >>> for p in pi.SimulatedStage.load('paper').model.parameters[-2:]:
        ...     print(p.part, p.name, f'{p.value:.4g}', p.unit or '-')
        G b_10 -0.001171 -
        delay d 3 samples
        """
        known = self.identification.get('uncertainties', {})
        known = known if isinstance(known, dict) else {}
        s, h, g = self.scaling, self.hysteresis, self.dynamics
        rows = [
            ModelParameter('H', f'r_{i}', s.V * float(r), 'V') for i, r in _numbered(h.thresholds)
        ]
        rows += _with_std('H', 'q', h.weights, known.get('weights'))
        rows += [
            ModelParameter('H', name, float(getattr(h, name)), '', _number(known.get(name)))
            for name in ('p0', 'p1', 'p2')
            if name != 'p0' or h.p0 != 0.0
        ]
        rows += _with_std('G', 'a', g.a, known.get('a'))
        rows += _with_std('G', 'b', g.b, known.get('b'))
        total = self.delay.total
        rows.append(ModelParameter('delay', 'd', total, 'samples', _number(known.get('delay'))))
        for setting in self.effects:
            units = {p.name: p.unit for p in find_effect(setting.name).parameters}
            for name, value in setting.parameters.items():
                many = isinstance(value, Sequence | np.ndarray) and not isinstance(value, str)
                for i, x in _numbered(value) if many else [(0, value)]:
                    own = f'{name}_{i}' if many else name
                    one = x if isinstance(x, str) else float(x)
                    rows.append(ModelParameter(setting.name, own, one, units[name]))
        return Parameters((*rows, *self.quantities))

    def bode(self: Any, frequency: ArrayLike | None = None) -> Bode:
        """
        Evaluate G and the delay over frequency, with the gain of the whole stroke.

        H is replaced by the straight line through its ends.  Effects are left out.

        Parameters
        ----------
        frequency : array_like, shape (n,), optional
            [Hz], from zero to half the sampling rate.  Default: logarithmically spaced.

        Raises
        ------
        DataError
            When a frequency lies outside of that range.

        Examples
        --------
        >>> import piezo_ident as pi
        >>> bode = pi.SimulatedStage.load('paper').model.bode([1.0])
        >>> f'{1e6 * bode.gain[0]:.2f} um/V, {bode.phase[0]:.2f} deg'
        '7.13 um/V, -0.13 deg'
        """
        highest = 0.5 * self.sample_rate
        if frequency is None:
            f = np.geomspace(LOWEST * highest, highest, POINTS)
        else:
            f = np.atleast_1d(np.asarray(frequency, dtype=np.float64))
        if f.ndim != 1 or not np.all((f >= 0.0) & (f <= highest)):
            raise DataError(f'bode: give frequencies from 0 to {highest:g} Hz, in a list')
        delay, z = self.total_delay, np.exp(-2j * np.pi * f / self.sample_rate)
        response = self.dynamics.response(f, self.sample_rate) * z**delay.samples
        response = _line(self) * response * (1.0 - delay.fraction + delay.fraction * z)
        return Bode(f, np.abs(response), np.degrees(np.unwrap(np.angle(response))))

    def to_tf(self: Any) -> TransferFunction:
        """
        Convert G and the delay to a transfer function of python-control, from V to m.

        H is replaced by the straight line through its ends, as in `bode`.

        Raises
        ------
        ConfigError
            When python-control is not installed.
        """
        try:
            from control import TransferFunction
        except ImportError:
            raise ConfigError(
                "to_tf needs python-control; install it by pip install 'piezo_ident[control]'"
            ) from None
        delay = self.total_delay
        b = np.convolve(self.dynamics.b, [1.0 - delay.fraction, delay.fraction])
        a = np.append(1.0, self.dynamics.a)
        # powers of 1/z to powers of z
        size = max(a.size, b.size)
        numerator = _line(self) * np.pad(b, (0, size - b.size))
        denominator = np.pad(a, (0, size - a.size + delay.samples))
        return TransferFunction(numerator, denominator, 1.0 / self.sample_rate)

    def summary(self: Any) -> str:
        """
        Describe range, hysteresis, modes, delay, effects and known errors as text.

        Examples
        --------
        >>> import piezo_ident as pi
        >>> 'delay' in pi.SimulatedStage.load('paper').model.summary()
        True
        """
        import piezo_ident as pi

        return pi.report.model_text(self)

    def save(self: Any, path: str | os.PathLike[str]) -> None:
        """
        Write the model file; an old file stays whole until the new file is complete.

        Raises
        ------
        DataError
            When the file cannot be written.

        Examples
        --------
        >>> import piezo_ident as pi
        >>> pi.SimulatedStage.load('paper').model.save('model.yaml')
        >>> pi.load('model.yaml').delay.samples
        3
        """
        from piezo_ident.model.files import model_to_yaml

        write_text(path, model_to_yaml(self))


class AxesFrontDoor:
    """Base class of `MultiAxisModel`: predict, score and invert all axes together."""

    def predict(self: Any, record: Record, interval: float | None = None) -> EachAxis[FreeRun]:
        """Predict a measured record in free run, as `piezo_ident.free_run`."""
        from piezo_ident import free_run

        runs: EachAxis[FreeRun] = free_run(self, record, interval)
        return runs

    def score(self: Any, record: Record) -> dict[str, FreeRunErrors]:
        """
        Rate the free run of each axis on a measured record, as `StageModel.score`.

        Examples
        --------
        >>> import numpy as np
        >>> import piezo_ident as pi
        >>> one = pi.SimulatedStage.load('paper').model
        >>> stage = pi.MultiAxisModel({'y': one, 'y_b': one})
        >>> v = 5 - 5 * np.cos(np.arange(4000) / 100)
        >>> y, second = stage.simulate({'v': v, 'v_b': v})['y'], {'v_b': v, 'y_b': one.simulate(v)}
        >>> record = pi.Record.from_arrays(v, y, sample_rate=20e3, channels=second)
        >>> {axis: errors.percent < 1e-6 for axis, errors in stage.score(record).items()}
        {'y': True, 'y_b': True}
        """
        return {a: run.errors_after_start or run.errors for a, run in self.predict(record).items()}

    def inverse(self: Any, wanted: Mapping[str, ArrayLike], **options: Any) -> MultiAxisInverse:
        """Find the voltages that move the axes as wanted, as `piezo_ident.invert`."""
        from piezo_ident import invert

        return invert(self, wanted, **options)


def _line(model: Any) -> float:
    """Gain of the straight line through the ends of H [m/V]."""
    s = model.scaling
    u = s.u(np.array(s.range))
    w = model.hysteresis(u)
    return float(s.Y * (w[1] - w[0]) / (s.V * (u[1] - u[0])))


def _numbered(values: Any) -> list[tuple[int, Any]]:
    return list(enumerate(values, 1))


def _number(value: Any) -> float | None:
    known = isinstance(value, int | float) and math.isfinite(value)
    return float(value) if known else None


def _with_std(part: str, name: str, values: Array, stds: Any) -> list[ModelParameter]:
    """Rows of a list of coefficients; deviations of another length belong to another fit."""
    known = (
        stds if isinstance(stds, Sequence) and len(stds) == values.size else [None] * values.size
    )
    return [
        ModelParameter(part, f'{name}_{i}', float(x), '', _number(e))
        for (i, x), e in zip(_numbered(values), known, strict=True)
    ]
