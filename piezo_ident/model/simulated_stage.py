# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Simulated stage: a model between a digital-to-analogue converter and a noisy, sampled sensor.

    command --> [DAC] --> applied voltage --> [StageModel] --> [+ noise] --> [ADC] --> reading

Its configuration is a model file with two more keys, ``sensor`` and ``seed``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
import math
import os
import reprlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array
from piezo_ident.common.config import find_config
from piezo_ident.common.errors import ConfigError
from piezo_ident.common.files import load_yaml
from piezo_ident.excitation.program import Program, Sequence
from piezo_ident.model.files import check_keys, model_from_dict, number, numbers
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import CHUNK
from piezo_ident.record.record import Fault, Piece, Record

_SENSOR = ('noise_rms', 'dac_bits', 'dac_range', 'adc_bits', 'adc_range')


@dataclass(frozen=True)
class Converter:
    """
    Converter between numbers and a physical quantity, with a range in the unit of the quantity.

    Its codes are ``low + k (high - low) / 2^bits``, k = 0 .. 2^bits - 1.  Zero is therefore a code
    of every symmetric range, and `high` lies one step above the last code.  Raises ConfigError if
    the resolution is not within 1 .. 32 bits, or the range is empty.
    """

    bits: int
    low: float
    high: float

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= 32:
            raise ConfigError(f'a converter has 1 .. 32 bits, got {self.bits}')
        if not self.low < self.high:
            raise ConfigError(
                f'a converter range is [lowest, highest], got [{self.low:g}, {self.high:g}]'
            )

    @property
    def step(self) -> float:
        """Smallest difference between two codes."""
        return (self.high - self.low) / 2.0**self.bits

    def quantise(self, x: Array) -> Array:
        """Round to the nearest codes; a value outside the range becomes the code at its end."""
        code = np.clip(np.rint((x - self.low) / self.step), 0.0, 2.0**self.bits - 1.0)
        return np.asarray(self.low + self.step * code)

    def outside(self, x: Array) -> int:
        """Count the values outside the range."""
        return int(np.count_nonzero((x < self.low) | (x > self.high)))


@dataclass(frozen=True)
class Sensor:
    """
    White noise of the sensor [m, rms], and the converters between computer and stage.

    The DAC is in front of the amplifier [V], the ADC behind the sensor [m].  None stands for an
    ideal converter.
    """

    noise_rms: float = 0.0
    dac: Converter | None = None
    adc: Converter | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.noise_rms) and self.noise_rms >= 0):
            raise ConfigError(f'noise_rms must not be negative, got {self.noise_rms} m')


@dataclass(frozen=True)
class SimulatedStage:
    """
    Simulated stage: a model with converters and sensor noise.

    Attributes
    ----------
    model : StageModel
    sensor : Sensor
    seed : int
        Seed of the sensor noise.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> stage = pi.SimulatedStage.load('paper')
    >>> record = stage.play(pi.Program.load('minor_loops'))
    >>> 60e-6 < record.stroke < 80e-6
    True
    """

    model: StageModel
    sensor: Sensor = field(default_factory=Sensor)
    seed: int = 0

    @classmethod
    def load(cls, name_or_path: str | os.PathLike[str]) -> SimulatedStage:
        """
        Read a simulated stage: ``paper``, ``dense`` or ``effects``, or a file of the user.

        Raises
        ------
        ConfigError
            If the file cannot be read, or its sensor is invalid.
        ModelError
            If its model is invalid.

        Examples
        --------
        >>> import piezo_ident as pi
        >>> pi.SimulatedStage.load('paper').model.sample_rate
        20000.0
        """
        path = find_config(name_or_path, 'stage')
        return stage_from_dict(load_yaml(path), str(path))

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes: a single axis, without a name."""
        return ('',)

    @property
    def sample_rate(self) -> float:
        """Sampling rate [Hz]."""
        return self.model.sample_rate

    @property
    def ideal(self) -> SimulatedStage:
        """Same stage without noise and converters: its record is the displacement itself."""
        return SimulatedStage(self.model)

    def run(self, rng: np.random.Generator) -> StageRun:
        """Start a run of this stage that takes the command block by block."""
        return StageRun(self, rng)

    def play(
        self,
        program: Program | Sequence,
        rng: np.random.Generator | None = None,
        name: str = 'simulated',
    ) -> Record:
        """
        Play a program on the stage, and record the measurement.

        Parameters
        ----------
        program : Program or Sequence
            Command; the record holds it as its voltage.
        rng : numpy.random.Generator, optional
            Generator of the sensor noise; by default one with the seed of the stage.
        name : str, optional
            Name of the record.

        Returns
        -------
        Record
            Measurement, with a fault for each converter whose range the signal leaves.

        Raises
        ------
        ConfigError
            If the program cannot be built at the sampling rate of the stage.
        ModelError
            If stage and sequence differ in sampling rate.

        Examples
        --------
        >>> import piezo_ident as pi
        >>> stage = pi.SimulatedStage.load('paper')
        >>> record = stage.play(pi.Program.load('validation'))
        >>> [s.label for s in record.pieces[0].segments if s.kind == 'sine'][:2]
        ['sine:1Hz', 'sine:10Hz']
        """
        model = self.model
        sequence = program.build(model.sample_rate) if isinstance(program, Program) else program
        run = self.run(np.random.default_rng(self.seed) if rng is None else rng)
        # a piece without measurement checks the rate and supplies the time
        piece = _piece(sequence, np.zeros(sequence.n))
        model.check_rate(piece)
        t, y = piece.t, np.empty(sequence.n)
        for start in range(0, sequence.n, CHUNK):
            cut = slice(start, start + CHUNK)
            y[cut] = run.process(sequence.v[cut], t[cut])
        clipped = {'voltage': run.clipped_input, 'displacement': run.clipped_output}
        faults = tuple(
            Fault('clipping', where, count, 'held at the end of the converter range')
            for where, count in clipped.items()
            if count
        )
        return Record((_piece(sequence, y),), name, faults)


class StageRun:
    """
    Run of a simulated stage, block by block, in volts and metres.

    The stage is at rest under the first command.  `clipped_input` and `clipped_output` count the
    samples so far that left the range of the DAC and of the ADC.
    """

    def __init__(self, stage: SimulatedStage, rng: np.random.Generator) -> None:
        self.stage = stage
        self.clipped_input = self.clipped_output = 0
        self._rng = rng
        self._stream = stage.model.stream()

    def applied(self, v: ArrayLike) -> Array:
        """Compute the output of the DAC for a command [V], shape (n,)."""
        command, dac = np.asarray(v, dtype=np.float64), self.stage.sensor.dac
        return command if dac is None else dac.quantise(command)

    def process(
        self, v: ArrayLike, t: ArrayLike | None = None, channels: Mapping[str, Array] | None = None
    ) -> Array:
        """
        Compute the readings of the sensor [m] for the next samples of command [V], shape (n,).

        The time [s] is counted from the first sample by default.  `channels` are further signals
        that effects of the model need.
        """
        sensor = self.stage.sensor
        command = np.asarray(v, dtype=np.float64)
        if sensor.dac is not None:
            self.clipped_input += sensor.dac.outside(command)
        y = self._stream.process(self.applied(command), t, channels)
        if sensor.noise_rms > 0:
            y = y + sensor.noise_rms * self._rng.standard_normal(y.size)
        if sensor.adc is not None:
            self.clipped_output += sensor.adc.outside(y)
            y = sensor.adc.quantise(y)
        return y


def _piece(sequence: Sequence, y: Array) -> Piece:
    return Piece(v=sequence.v, y=y, sample_rate=sequence.sample_rate, segments=sequence.segments)


def stage_from_dict(data: Mapping[str, Any], name: str = 'stage') -> SimulatedStage:
    """
    Build a simulated stage from plain data; see `SimulatedStage.load`.

    The data are those of a model, with the keys ``sensor`` and ``seed``.  A plain model file is an
    ideal stage.
    """
    sensor = data.get('sensor') or {}
    if not isinstance(sensor, Mapping):
        raise ConfigError(f'{name}: sensor must be a mapping, see config/stage_paper.yaml')
    check_keys(sensor, _SENSOR, ' in sensor', name)
    seed = seed_of(data, name)
    model = model_from_dict({k: v for k, v in data.items() if k not in ('sensor', 'seed')}, name)
    where = f'{name}: sensor'
    noise_rms = number(sensor, 'noise_rms', where, 0.0)
    try:
        dac, adc = (_converter(sensor, which, where) for which in ('dac', 'adc'))
        return SimulatedStage(model, Sensor(noise_rms, dac, adc), seed)
    except ConfigError as error:
        raise ConfigError(f'{where}: {error}') from None


def seed_of(data: Mapping[str, Any], name: str) -> int:
    """Read the seed in the configuration of a stage; 0 by default."""
    seed = data.get('seed', 0)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ConfigError(f'{name}: seed must be a whole number >= 0, got {reprlib.repr(seed)}')
    return seed


def _converter(sensor: Mapping[str, Any], which: str, where: str) -> Converter | None:
    bits, ends = f'{which}_bits', f'{which}_range'
    if sensor.get(bits) is None and sensor.get(ends) is None:
        return None
    if sensor.get(bits) is None or sensor.get(ends) is None:
        raise ConfigError(f'give both {bits} and {ends}: [lowest, highest]')
    count, limits = number(sensor, bits, where), numbers(sensor, ends, where)
    if not count.is_integer() or limits.size != 2:
        raise ConfigError(
            f'{bits} = {count:g} must be a whole number, {ends} = {limits.tolist()} two numbers'
        )
    return Converter(int(count), float(limits[0]), float(limits[1]))
