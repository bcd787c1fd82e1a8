# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Settings and results of a diagnosis."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import ConfigError, expect_numbers, ModelError
from piezo_ident.common.showable import Showable
from piezo_ident.effects import find_effect
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Fault, Piece
from piezo_ident.selection.judged import JudgedRun, Promise

FORMULA = (
    '100 rms(y - y_hat) / (max y - min y), free run, the zero of each record free; before: the '
    'model as it was given; after: each kind of motion with the parameters fitted to the others'
)

#: changes of a model that are no effects of the catalogue
UNNAMED = REFITTED, RETUNED = 'refitted H', 'retuned G'


@dataclass(frozen=True)
class DiagnosisSettings:
    """
    Settings of a diagnosis.

    Attributes
    ----------
    effects, without : tuple of str
        Candidates, by default the whole catalogue, and candidates to leave out.
    most_effects : int
        Largest number of effects that are added.
    most_samples : int
        Largest number of samples that are searched and fitted, from the beginnings of the records.
        A sample needs 0.9 to 1.3 kB of memory.
    seed : int
        Seed of all random numbers.

    Raises
    ------
    ConfigError
        If a name is not in the catalogue, or a number is out of range.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> pi.DiagnosisSettings(effects=('creep', 'slew_limit')).most_effects
    4
    """

    effects: tuple[str, ...] | None = None
    without: tuple[str, ...] = ()
    most_effects: int = 4
    most_samples: int = 2_400_000
    seed: int = 0

    def __post_init__(self) -> None:
        expect_numbers(self)
        for name in (*(self.effects or ()), *self.without):
            try:
                find_effect(name)
            except ModelError as error:
                raise ConfigError(str(error)) from None
        if not 1 <= self.most_effects <= 10:
            raise ConfigError(f'most_effects must be 1 to 10, got {self.most_effects}')
        if self.most_samples < 1000:
            raise ConfigError(f'most_samples must be at least 1000, got {self.most_samples}')
        if self.seed < 0:
            raise ConfigError(f'seed must not be negative, got {self.seed}')


@dataclass(frozen=True)
class FoundParameter:
    """Fitted parameter: value, unit, and its standard deviation if it is known."""

    value: float | str | tuple[float, ...]
    unit: str
    std: float | tuple[float, ...] | None


@dataclass(frozen=True, eq=False)
class FoundEffect:
    """
    Effect that was added to the model, in one of the slots of its chain.

    `share` (0 .. 1) is the part of the explainable error that the effect removes, and
    `rms_percent` is the rms of this part in % of stroke.
    """

    name: str
    slot: str
    share: float
    rms_percent: float
    parameters: Mapping[str, FoundParameter]


@dataclass(frozen=True)
class Class:
    """Effects that these data cannot separate, and an experiment that separates them."""

    names: tuple[str, ...]
    separating_experiment: str


@dataclass(frozen=True)
class OtherGain:
    """
    Ratio of the gain of the stage to the gain of the model, and the error that it explains.

    `share` (0 .. 1) is relative to the error of the model as given beyond the noise.
    """

    value: float
    share: float


@dataclass(frozen=True)
class Candidate:
    """Candidate that was not added: its share of the explainable error alone, and a reason."""

    name: str
    share: float
    why_not: str


@dataclass(frozen=True)
class Unexplained:
    """Error left beyond the noise: share of the explainable error, rms [% of stroke], text."""

    share: float
    rms_percent: float
    description: str


@dataclass(frozen=True)
class Untestable:
    """Effect that these data cannot show, and the data that would show it."""

    name: str
    needs: str


@dataclass(frozen=True)
class Errors:
    """Free-run errors [% of stroke]: overall, by segment label, by frequency of a sine [Hz]."""

    overall: float
    by_segment: Mapping[str, float]
    by_frequency: Mapping[str, float]


@dataclass(frozen=True)
class Unseen:
    """
    Errors on a record that took no part in a diagnosis, % of its stroke.

    Attributes
    ----------
    record : str
    before, after : float
        Errors of the given and of the refined model.  If the record does not start at rest, its
        start is estimated from a first part, and the errors exclude this part.
    before_centred, after_centred : float
        The same errors without their mean, as a sensor may have been zeroed again.
    n : int
        Number of judged samples.
    sines : tuple of (float, float, float)
        Frequency [Hz] of each sine, and the errors before and after in steady state.
    """

    record: str
    before: float
    after: float
    before_centred: float
    after_centred: float
    n: int
    sines: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True, eq=False)
class Residual:
    """
    One piece with its residuals, measured minus predicted [m], shape (n,).

    `given` is the residual of the model as given, `before` of the refitted base model, and `after`
    of the refined model.  `sound` marks the samples that count.
    """

    record: str
    piece: Piece
    given: Array
    before: Array
    after: Array
    sound: Mask

    @property
    def run(self) -> JudgedRun:
        """Free run of the refined model, as fitted."""
        none = np.zeros_like(self.sound)
        return JudgedRun(self.record, self.piece, self.piece.y - self.after, self.sound, none)


def stroke_of(residuals: Iterable[Residual]) -> float:
    """Compute the largest stroke of the pieces [m]."""
    return max(float(np.ptp(r.piece.y[r.sound])) for r in residuals if r.sound.any())


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Showable):
    """
    Result of a diagnosis.

    Attributes
    ----------
    verdict : {'named', 'class', 'partly_explained', 'refitted', 'unexplained', 'none'}
    sentence : str
        The verdict in words.
    given, model : StageModel
        The judged model and the refined model; the same model if it stays as given.
    effects : tuple of FoundEffect
        Effects that were added, in the order of the search.
    group : Class or None
        Effects that these data cannot separate.  If no effect was added, the group holds effects
        that may hide in the refitted H.
    unexplained : Unexplained
    candidates : tuple of Candidate
        Best first.
    before, refit, after : Errors
        Errors of three models.  `before`: the model as given.  `refit`: the refitted base model,
        on held-out blocks.  `after`: the refined model, on whole held-out kinds of motion.  In
        `after` effects of time, and the H refitted with them, count as in these records.  The
        refined model omits both if nothing else was found.
    noise_floor, noise_source : float or None, str
        Rms of single samples, % of stroke.
    smallest_detectable : float or None
        Rms of the smallest effect that would have been taken, % of stroke.
    untestable, faults, residuals, records, warnings, settings
    blocks : int
        Number of blocks that were held out in turn.
    unseen : tuple of Unseen
        Errors on records that took no part.
    law : str
        Law of the fitted H, a name of `piezo_ident.operators.hysteresis_law.LAWS`; empty if H
        stays as given.
    errors_of_laws : mapping of str to float
        Errors of H refitted as plays and as wider laws, on held-out kinds of motion, % of stroke.
    kinds : tuple of str
        Kinds of motion that were held out in turn; empty if parts of the data replaced them.
    gain : OtherGain or None
        The other gain, if it explains the error as well as a refit of H.
    set_in : bool
        Whether an effect has appeared since the identification.  If so, shares are relative to the
        error of the model as given; otherwise to the error of the best H.
    outside : float
        Share of the samples whose voltage lies outside the range of the given model.
    held_out : Errors or None
        Errors of the refined model on blocks that were held out in turn, as `after`.
    errors_of_sets : mapping of tuple of str to tuple of float
        Errors that the best candidate of each set of effects leaves on the kinds of motion held
        out, less most of the noise, % of stroke.  A set ends with its changes of `UNNAMED`.
    promise : Promise or None
    weights : mapping of str to float
        Weight of each set of effects, joined by ``+``, and of ``none of these``; the sum is one.

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> model = pi.SimulatedStage.load('paper').model
    >>> v = 5 - 5 * np.cos(2 * np.pi * 20 * np.arange(20_000) / 20_000)
    >>> record = pi.Record.from_arrays(v, model.simulate(v), sample_rate=20_000)
    >>> result = pi.diagnose(model, record, pi.DiagnosisSettings(effects=('saturation',)))
    >>> result.verdict, result.effects
    ('none', ())
    """

    verdict: str
    sentence: str
    given: StageModel
    model: StageModel
    effects: tuple[FoundEffect, ...]
    group: Class | None
    unexplained: Unexplained
    candidates: tuple[Candidate, ...]
    before: Errors
    refit: Errors
    after: Errors
    noise_floor: float | None
    noise_source: str
    smallest_detectable: float | None
    untestable: tuple[Untestable, ...]
    faults: tuple[Fault, ...]
    residuals: tuple[Residual, ...]
    records: tuple[str, ...]
    blocks: int
    warnings: tuple[str, ...]
    settings: DiagnosisSettings
    unseen: tuple[Unseen, ...] = ()
    law: str = ''
    errors_of_laws: Mapping[str, float] = field(default_factory=dict)
    kinds: tuple[str, ...] = ()
    gain: OtherGain | None = None
    set_in: bool = False
    outside: float = 0.0
    held_out: Errors | None = None
    errors_of_sets: Mapping[tuple[str, ...], tuple[float, ...]] = field(default_factory=dict)
    promise: Promise | None = None
    weights: Mapping[str, float] = field(default_factory=dict)

    @property
    def errors(self) -> Mapping[str, float]:
        """Errors of the three models over all kinds of motion, % of stroke."""
        return {name: getattr(self, name).overall for name in ('before', 'refit', 'after')}

    @property
    def stroke(self) -> float:
        """Largest stroke of the records [m]."""
        return stroke_of(self.residuals)

    @property
    def runs(self) -> list[JudgedRun]:
        """Free runs of the refined model, as fitted."""
        return [r.run for r in self.residuals]

    @property
    def changes(self) -> tuple[str, ...]:
        """Changes from the given to the refined model in words."""
        return changes(self.given, self.model)


def changes(given: StageModel, refined: StageModel) -> tuple[str, ...]:
    """List the changes from a given to a refined model in words."""
    texts = []
    # plays without weight do nothing
    old, new = (m.hysteresis.without_idle().numbers for m in (given, refined))
    if not np.array_equal(old, new):
        texts.append('H refitted')
    if given.scaling != refined.scaling:
        texts.append('offset refitted')
    if given.delay != refined.delay:
        texts.append('another delay')
    G, other = given.dynamics, refined.dynamics
    if not (np.array_equal(G.a, other.a) and np.array_equal(G.b, other.b)):
        texts.append('G retuned')
    before = {e.name: _frozen(e.parameters) for e in given.effects}
    after = {e.name: _frozen(e.parameters) for e in refined.effects}
    for e in refined.effects:
        idle = find_effect(e.name).is_neutral(e.parameters)
        if e.name not in before:
            texts.append(f'with {e.name}{", switched off" if idle else ""}')
    texts += [f'{name} refitted' for name in after if before.get(name, after[name]) != after[name]]
    return (*texts, *(f'without {name}' for name in sorted(set(before) - set(after))))


def _frozen(values: Mapping[str, object]) -> list[tuple[str, str]]:
    return sorted((k, repr(np.asarray(x).tolist())) for k, x in values.items())
