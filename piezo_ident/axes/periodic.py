# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Several inputs and outputs under a periodic excitation, and whether they repeat.

A stage in steady state under a periodic voltage repeats itself.  What differs between two periods
is noise, or the stage was not the same in both: a record with far more of it than the others is
reported, with the frequencies where it lies, and counts less in a fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import interpolated, Mask
from piezo_ident.common.errors import DataError

#: a record that differs between periods by so many times the median of all is suspicious
SUSPICIOUS = 3.0
#: bands in which the difference is compared
BANDS = 16
#: times that what stands in for lost readings and the mean of a period are found from one another;
#: each leaves the share that is lost of what is wrong
TURNS = 3


@dataclass(frozen=True, eq=False)
class PeriodicRecord:
    """
    Whole periods of a stage in steady state.

    Parameters
    ----------
    name : str
        What the record is called in messages.
    group : str
        Records of one amplitude, or of one condition, share it.
    rate : float
        Samples a second.
    u, y : ndarray, shape (periods, samples, inputs) and (periods, samples, outputs)
        Voltages and displacements.  The mean of y is taken off: steady state does not tell where
        a stage stands.  Where y is given as NaN, a reading was lost: those of other periods stand
        in for it, or a straight line.

    Attributes
    ----------
    sound : ndarray of bool, shape of y
        False where a reading was lost, which no error counts.
    """

    name: str
    group: str
    rate: float
    u: NDArray[np.float64]
    y: NDArray[np.float64]
    sound: Mask = field(init=False)

    def __post_init__(self) -> None:
        u, y = (np.array(x, dtype=float) for x in (self.u, self.y))
        if u.ndim != 3 or y.ndim != 3 or u.shape[:2] != y.shape[:2]:
            raise DataError(
                f'{self.name}: u {u.shape} and y {y.shape} are not (periods, samples, channels) '
                'of equal periods and samples'
            )
        sound = ~np.isnan(y)
        if not sound.any(axis=1).all():
            raise DataError(f'{self.name}: a channel of y holds no reading of a whole period')
        y = _about_mean(y, sound)
        for label, x in (('u', u), ('y', y)):
            if not np.isfinite(x).all():
                raise DataError(f'{self.name}: {label} holds values that are not finite')
            if not np.ptp(x, axis=1).all():
                raise DataError(f'{self.name}: a channel of {label} rests throughout a period')
        for name, value in {'u': u, 'y': y, 'sound': sound}.items():
            object.__setattr__(self, name, value)

    @property
    def mean_u(self) -> NDArray[np.float64]:
        """Voltages averaged over the periods, shape (samples, inputs)."""
        return np.asarray(self.u.mean(axis=0))

    @property
    def mean_y(self) -> NDArray[np.float64]:
        """Displacements averaged over the periods, shape (samples, outputs)."""
        return np.asarray(self.y.mean(axis=0))

    def error(self, answer: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return y - answer over the last period without its mean; NaN where y was lost."""
        e = np.where(self.sound[-1], self.y[-1] - answer, np.nan)
        return np.asarray(e - np.nanmean(e, axis=0))

    @property
    def noise(self) -> NDArray[np.float64]:
        """Noise of one period, estimated from what differs between the last two."""
        if len(self.y) < 2:
            raise DataError(f'{self.name}: noise needs two periods, not {len(self.y)}')
        both = self.sound[-1] & self.sound[-2]
        # as much as if no reading had been lost
        share = np.maximum(both.mean(axis=0), 1 / len(both))
        return np.asarray(np.where(both, self.y[-1] - self.y[-2], 0.0) / np.sqrt(2 * share))


def _about_mean(y: NDArray[np.float64], sound: Mask) -> NDArray[np.float64]:
    """Return displacements without the mean of each period, what was lost filled in."""
    if sound.all():
        return np.asarray(y - y.mean(axis=1, keepdims=True))
    count = sound.sum(axis=0)
    y = y - np.nanmean(y, axis=1, keepdims=True)
    for _ in range(TURNS):
        usual = np.where(sound, y, 0.0).sum(axis=0) / np.maximum(count, 1)
        lines = [interpolated(x, n == 0) for x, n in zip(usual.T, count.T, strict=True)]
        y = np.where(sound, y, np.column_stack(lines))
        y -= y.mean(axis=1, keepdims=True)
    return y


@dataclass(frozen=True)
class Periodicity:
    """
    How well one record repeats itself.

    Attributes
    ----------
    difference : float
        rms of the difference between the last two periods in % of rms(y).
    weight : float
        Factor for the errors of this record in a fit, 1 where it repeats as the others do.
    band : tuple of float or None
        Frequencies in Hz between which the difference stands out, where it does.
    """

    name: str
    difference: float
    weight: float
    band: tuple[float, float] | None

    @property
    def suspicious(self) -> bool:
        """Whether the record repeats itself far worse than the others."""
        return self.band is not None

    def __str__(self) -> str:
        if self.band is None:
            return f'{self.name}: {self.difference:.1f} % between periods'
        return (
            f'{self.name}: {self.difference:.1f} % between periods, mostly at '
            f'{self.band[0]:.0f} to {self.band[1]:.0f} Hz, far more than the other records; '
            f'it counts {self.weight:.2f} in the fit'
        )


def periodicity(records: Sequence[PeriodicRecord]) -> tuple[Periodicity, ...]:
    """
    Compare what differs between periods with the median of all records.

    Parameters
    ----------
    records : sequence of PeriodicRecord
        At least two periods each.

    Returns
    -------
    tuple of Periodicity
        In the order of the records.
    """
    spectra = np.array([_band_noise(record) for record in records])
    usual = np.median(spectra, axis=0)
    totals = np.sqrt(spectra.sum(axis=1))
    limit = SUSPICIOUS * float(np.median(totals))
    found = []
    for record, spectrum, total in zip(records, spectra, totals, strict=True):
        band = None
        if total > limit:
            # the bands that hold nine tenths of what is more than usual
            excess = np.maximum(spectrum - usual, 0)
            order = np.argsort(excess)[::-1]
            held = np.cumsum(excess[order]) / excess.sum()
            chosen = order[: int(np.searchsorted(held, 0.9)) + 1]
            width = record.rate / 2 / BANDS
            band = (float(chosen.min() * width), float((chosen.max() + 1) * width))
        found.append(
            Periodicity(
                record.name,
                100 * float(total) * np.sqrt(2),
                1.0 if band is None else float(np.median(totals) / total),
                band,
            )
        )
    return tuple(found)


def _band_noise(record: PeriodicRecord) -> NDArray[np.float64]:
    """Return the noise power in bands of equal width, as a share of the power of y."""
    power = (np.abs(np.fft.rfft(record.noise, axis=0)) ** 2).sum(axis=1)
    whole = (np.abs(np.fft.rfft(record.y[-1], axis=0)) ** 2).sum()
    return np.asarray([part.sum() / whole for part in np.array_split(power, BANDS)])
