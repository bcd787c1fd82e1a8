# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What the measured fast steering mirror of CubeSpec has and a linear model lacks.

    python benchmarks/study_mirror.py docs/mirror.md --pictures docs/images

Reads fsm/{u,y}_{100,200,300}mV_train.npy from ../shared/data or PIEZO_IDENT_DATA; where the folder
holds {u,y}_..mV_test.npy besides, they are judged as well.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
import os
from pathlib import Path
import sys
import textwrap
import time

# the fits run on threads of their own
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from amplitude_dependence import amplitude_dependence, AmplitudeDependence
from matplotlib.figure import Figure
import numpy as np
from piezo_ident.axes.explain import explain, Explanation, groups, Rival, Score, scores
from piezo_ident.axes.linear_fit import choose_order
from piezo_ident.axes.loop_fit import loop_fit
from piezo_ident.axes.loop_model import LoopModel
from piezo_ident.axes.periodic import Periodicity, periodicity, PeriodicRecord
from piezo_ident.common.arrays import Array
from piezo_ident.report.figures import style

RATE = 6400.0
AMPLITUDES = (100, 200, 300)
#: realisations, from zero, that no fit sees
HELD_OUT = (4, 5)
ORDERS = (28, 36, 44, 52)
#: time constants of the level in samples that are tried besides that of the model
MEMORIES = (5.0, 30.0)
#: published on the test part, pooled, one model for all amplitudes
PUBLISHED = {
    'published, linear': (18.6, 6.6, 16.3),
    'published, nonlinear (28 states and a neural network)': (6.37, 4.84, 4.19),
}

NAMES = {
    'linear': 'one linear model',
    'changed_dynamics': 'changed dynamics: a linear model for each amplitude',
    'input_hysteresis': 'input hysteresis: plays of the voltages',
    'loop_hysteresis': 'loop hysteresis: plays of the extension, inside the loop',
    'softening': 'softening by the level of the extension, inside the loop',
    'hysteretic_stiffness': '**hysteretic stiffness**: softening and plays inside the loop',
}

TEXT = """\
# A measured fast steering mirror

This page shows, on a measured stage of three axes, how an effect inside the mechanics is named.
`make mirror` made it, in {minutes:.1f} minutes on {cores} cores{beside}.

The fine steering mirror of CubeSpec has three piezo actuators and three displacement sensors. The
records are the training part of a public benchmark: M. Floren, KU Leuven,
[doi:10.5281/zenodo.19591136](https://doi.org/10.5281/zenodo.19591136), CC BY 4.0; none of it is
part of this project. Orthogonal multisines of random phase up to 3 kHz drive all three voltages at
once, at 100, 200 and 300 mV rms. Each amplitude has six realisations of 8192 samples at 6.4 kHz,
two periods in steady state.

**Held out**: realisations {held_out} (from zero) at each amplitude. They decide which effect is
named. The form of the candidates was found with their errors in view; the test part of the
benchmark, which is not used here, is the one clean judge.

## What a linear model lacks

{found}

| one model for all amplitudes | 100 mV | 200 mV | 300 mV | mean of outputs and realisations | s |
|---|---|---|---|---|---|
{rows}

The error is 100 rms(y - y_hat) / rms(y) in free run over the second period, pooled over all
outputs and realisations held out. The fifth column is the mean over outputs and realisations, for
100 / 200 / 300 mV. The published rows are pooled over all outputs of the test part.

![Spectra of the motion and of the errors](images/mirror_residual.png)

*Spectra of the outputs held out, of the errors of two models, and of the noise between periods:
rms in bands of 25 Hz, in % of rms(y).*

## What was added

    x(k+1) = A x(k) + B u(k) + E p(k)
    y(k)   = C x(k) + D u(k) + H p(k)
    z(k)   = F x(k) + G u(k)

The linear part has {order} states; the order was chosen by error in free run ({orders}).
Nine signals z act back on the mechanics as voltages would:

- three **soften** the stage: p = z (s - 1), where s is the rms of the three, followed with a time
  constant of {memory:.0f} samples ({memory_ms:.0f} ms); they begin as the extension of the
  actuators, G(0)^-1 y;
- three are sums of **plays** of five shared thresholds, beginning from the extension too;
- three are sums of plays, beginning from the voltages.

The fit by the error in free run ends at mixtures of motion and voltage, {parameters} numbers in
all. Piezo ceramics soften and lose more energy the more they are driven. The data show the effect
and not its cause: a joint that slips would look alike.

The model is stable at each level between {low:.2f} and {high:.2f}, the plays at rest; beyond them
the softening stays.

The time constant tells whether the stiffness follows the instant or the level. The softening
alone, refitted with other time constants:

| time constant / samples | 100 mV | 200 mV | 300 mV |
|---|---|---|---|
{memories}

## How the modes depend on the amplitude

![Frequency and damping of modes against the voltage](images/mirror_modes.png)

*Modes that stand alone, from a modal model refined at each amplitude: dots for the measured
records, lines for the answers of the named model.*

| mode / Hz | frequency at 100 / 200 / 300 mV | of the model | damping in % | of the model |
|---|---|---|---|---|
{modes}

Frequencies fall nearly in proportion to the amplitude, as by Rayleigh's law of small loops; the
damping of some modes rises.

## Records that do not repeat

{periodicity}

All others differ by {usual[0]:.1f} to {usual[1]:.1f} % between their periods.

## What is left

Noise is {noise} % of rms(y) in one period at 100 / 200 / 300 mV. The rest of the error repeats
from period to period and grows nearly in proportion to the amplitude. No candidate of this page
lowers it below 400 Hz and above 3 kHz.
"""


def data_folder() -> Path:
    """Return where the records are."""
    root = Path(__file__).resolve().parents[1]
    return Path(os.environ.get('PIEZO_IDENT_DATA', root.parent / 'shared' / 'data')) / 'fsm'


def load(folder: Path, part: str) -> list[PeriodicRecord]:
    """Read the records of one part."""
    found = []
    for amplitude in AMPLITUDES:
        u, y = (np.load(folder / f'{k}_{amplitude}mV_{part}.npy') for k in 'uy')
        # test records may come with one period
        u, y = (x if x.ndim == 4 else x[..., None] for x in (u, y))
        u, y = (x.transpose(2, 3, 0, 1) for x in (u, y))
        found += [
            PeriodicRecord(f'{amplitude} mV, realisation {i}', f'{amplitude} mV', RATE, u[i], y[i])
            for i in range(len(u))
        ]
    return found


def cells(found: dict[str, Score]) -> str:
    pooled = ' | '.join(f'{s.pooled:.2f}' for s in found.values())
    return f'{pooled} | {" / ".join(f"{s.mean:.2f}" for s in found.values())}'


def table(explanation: Explanation) -> str:
    """Return the rows of all models."""
    rows = [
        f'| {name} | {" | ".join(f"{e:.2f}" for e in errors)} | | |'
        for name, errors in PUBLISHED.items()
    ]
    rows += [
        f'| {NAMES[c.name]} | {cells(c.scores)} | {c.seconds:.0f} |'
        for c in explanation.candidates
    ]
    return '\n'.join(rows)


def spectra(records: Sequence[PeriodicRecord], candidate: Rival | None) -> Array:
    """Return the power of the errors, or of the motion, by line, as a share of that of y."""
    total, power = 0.0, 0.0
    for record in records:
        y = record.y[-1]
        error = y if candidate is None else candidate.models[record.group].error(record)
        total = total + (np.abs(np.fft.rfft(error, axis=0)) ** 2).sum(axis=1)
        power += float((np.abs(np.fft.rfft(y, axis=0)) ** 2).sum())
    return np.asarray(total / power)


def noise_spectra(records: Sequence[PeriodicRecord]) -> Array:
    total = sum((np.abs(np.fft.rfft(r.noise, axis=0)) ** 2).sum(axis=1) for r in records)
    return total / sum((np.abs(np.fft.rfft(r.y[-1], axis=0)) ** 2).sum() for r in records)


def in_bands(power: Array, edges: Array) -> Array:
    """Return 100 times the rms in each band."""
    frequency = np.arange(len(power)) * RATE / 2 / (len(power) - 1)
    sums, _ = np.histogram(frequency, edges, weights=power)
    return 100 * np.sqrt(sums)


def all_spectra(
    held_out: Sequence[PeriodicRecord], explanation: Explanation
) -> dict[str, list[Array]]:
    """Return spectra by what they are of, one a group."""
    parts = groups(held_out)
    candidates = {
        'motion': None,
        'one linear model': explanation['linear'],
        'linear for each amplitude': explanation['changed_dynamics'],
        'hysteretic stiffness': explanation['hysteretic_stiffness'],
    }
    found = {
        name: [spectra(part, candidate) for part in parts.values()]
        for name, candidate in candidates.items()
    }
    found['noise'] = [noise_spectra(part) for part in parts.values()]
    return found


def residual_picture(found: dict[str, list[Array]], names: Sequence[str]) -> Figure:
    """Draw the spectra at each amplitude."""
    fig = style.figure(6.2)
    panels = fig.subplots(len(names), 1, sharex=True, sharey=True)
    edges = np.arange(0.0, 3201.0, 25.0)
    colours = {
        'motion': style.BLACK,
        'one linear model': style.VERMILION,
        'hysteretic stiffness': style.BLUE,
        'noise': style.GREY,
    }
    for i, (axes, name) in enumerate(zip(panels, names, strict=True)):
        for what, colour in colours.items():
            axes.stairs(
                in_bands(found[what][i], edges), edges, color=colour, label=what, baseline=None
            )
        axes.set_yscale('log')
        axes.set_ylim(0.005, 60)
        axes.set_xlim(0, 3200)
        last = i == len(names) - 1
        style.tidy(axes, 'frequency / Hz' if last else '', '% of rms(y)')
        style.plain_log(axes.yaxis, 0.005, 60)
        style.note(axes, name)
    style.legend_above(panels[0])
    return fig


def modes_picture(measured: AmplitudeDependence, model: AmplitudeDependence) -> Figure:
    """Draw frequency and damping of each mode against the voltage."""
    fig = style.figure(3.4)
    left, right = fig.subplots(1, 2)
    colours = (style.BLUE, style.VERMILION, style.GREEN, style.ORANGE, style.PURPLE, style.BLACK)
    volts = 1e3 * measured.voltage
    for i, colour in zip(range(measured.frequency.shape[1]), colours, strict=False):
        first = measured.frequency[0, i]
        for found, look in ((measured, 'o'), (model, '-')):
            shift = 100 * (found.frequency[:, i] / first - 1)
            label = f'{first:.0f} Hz' if look == 'o' else None
            left.plot(volts, shift, look, color=colour, label=label, markersize=5)
            right.plot(volts, 100 * found.damping[:, i], look, color=colour, markersize=5)
    style.tidy(left, 'voltage rms / mV', 'frequency against 100 mV / %')
    style.tidy(right, 'voltage rms / mV', 'damping / %')
    style.legend(left, ncols=2)
    for axes in (left, right):
        axes.set_xticks(list(AMPLITUDES))
        axes.set_xlim(80, 320)
    right.set_ylim(bottom=0)
    return fig


def simulated(model: LoopModel, records: Sequence[PeriodicRecord]) -> list[PeriodicRecord]:
    """Return the records as the model would have moved."""
    found = []
    for record in records:
        u = record.mean_u
        y = model.simulate(u)
        found.append(replace(record, u=np.array([u, u]), y=np.array([y, y])))
    return found


def modes_rows(measured: AmplitudeDependence, model: AmplitudeDependence) -> str:
    rows = []
    for i in range(measured.frequency.shape[1]):
        parts = [f'{measured.frequency[0, i]:.0f}']
        for values, digits in (
            (measured.frequency, 1),
            (model.frequency, 1),
            (100 * measured.damping, 2),
            (100 * model.damping, 2),
        ):
            parts.append(' / '.join(f'{v:.{digits}f}' for v in values[:, i]))
        rows.append(f'| {" | ".join(parts)} |')
    return '\n'.join(rows)


def memory_rows(
    explanation: Explanation,
    taught: Sequence[PeriodicRecord],
    held_out: Sequence[PeriodicRecord],
    weights: Sequence[float],
) -> str:
    """Refit the softening with other time constants."""
    softening = explanation['softening']
    model = next(iter(softening.models.values()))
    few = [i for part in groups(taught).values() for i in _best_two(part, taught, weights)]
    rows = []
    for memory in MEMORIES:
        fitted = loop_fit(
            replace(model, memory=memory),
            [taught[i] for i in few],
            weights=[weights[i] for i in few],
            iterations=6,
        )
        found = scores(dict.fromkeys(softening.models, fitted), held_out)
        rows.append(f'| {memory:.0f} | {" | ".join(f"{s.pooled:.2f}" for s in found.values())} |')
    errors = ' | '.join(f'{s.pooled:.2f}' for s in softening.scores.values())
    return '\n'.join([*rows, f'| {model.memory:.0f} | {errors} |'])


def _best_two(
    part: Sequence[PeriodicRecord], taught: Sequence[PeriodicRecord], weights: Sequence[float]
) -> list[int]:
    places = [i for i, record in enumerate(taught) if any(record is member for member in part)]
    return sorted(places, key=lambda i: -weights[i])[:2]


def sentence(explanation: Explanation) -> str:
    """Say what was found."""
    best, linear = explanation[explanation.name], explanation['linear']

    def pooled(candidate: Rival) -> str:
        return ' / '.join(f'{s.pooled:.1f}' for s in candidate.scores.values())

    text = (
        f'Diagnosed: `{explanation.name}`. One model for the three amplitudes leaves '
        f'{pooled(best)} % of the motion at 100 / 200 / 300 mV on realisations that no fit saw, '
        f'where one linear model leaves {pooled(linear)} %, and a linear model made for each '
        f'amplitude {pooled(explanation["changed_dynamics"])} %. Hysteresis of the inputs alone '
        f'leaves {pooled(explanation["input_hysteresis"])} %: the effect sits inside the loop.'
    )
    return textwrap.fill(text, 99)


def main() -> None:
    """Write the page and its pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('out', type=Path)
    parser.add_argument('--pictures', type=Path)
    args = parser.parse_args()
    folder = data_folder()
    if not folder.is_dir():
        sys.exit(f'{folder} is not there; set PIEZO_IDENT_DATA to the folder that holds fsm')
    since = time.monotonic()

    def report(text: str) -> None:
        print(f'{time.monotonic() - since:4.0f} s  {text}', flush=True)

    records = load(folder, 'train')
    tested = periodicity(records)
    for item in tested:
        if item.suspicious:
            report(str(item))
    per_group = len(records) // len(AMPLITUDES)
    out = [i % per_group in HELD_OUT for i in range(len(records))]
    taught = [r for r, o in zip(records, out, strict=True) if not o]
    held_out = [r for r, o in zip(records, out, strict=True) if o]
    weights = [t.weight for t, o in zip(tested, out, strict=True) if not o]

    # the order is chosen by a realisation that is taught later
    middle = groups(taught)[f'{AMPLITUDES[1]} mV']
    linear, errors = choose_order(middle[:-1], middle[-1:], orders=ORDERS)
    report(f'{linear.order} states: {errors}')
    explanation = explain(linear, taught, held_out, weights=weights, report=report)
    model = explanation.model
    report(f'named: {explanation.name}')

    memories = memory_rows(explanation, taught, held_out, weights)
    good = [r for r, t in zip(records, tested, strict=True) if not t.suspicious]
    measured = amplitude_dependence(linear, good)
    of_model = amplitude_dependence(linear, simulated(model, good))
    found = all_spectra(held_out, explanation)
    if args.pictures is not None:
        for name, picture in (
            ('residual', residual_picture(found, list(groups(held_out)))),
            ('modes', modes_picture(measured, of_model)),
        ):
            picture.savefig(args.pictures / f'mirror_{name}.png', dpi=style.DPI)

    if (folder / f'u_{AMPLITUDES[0]}mV_test.npy').is_file():
        test = scores(dict.fromkeys(groups(records), model), load(folder, 'test'))
        report(f'test part: {cells(test)}')
    page = {
        'minutes': (time.monotonic() - since) / 60,
        'cores': os.cpu_count(),
        'beside': beside(time.process_time() / (time.monotonic() - since)),
        'held_out': ' and '.join(map(str, HELD_OUT)),
        'found': sentence(explanation),
        'rows': table(explanation),
        'order': linear.order,
        'orders': ', '.join(f'{o}: {e:.2f} %' for o, e in errors.items()),
        'memory': model.memory,
        'low': model.range[0],
        'high': model.range[1],
        'memory_ms': 1e3 * model.memory / RATE,
        'parameters': count(model),
        'memories': memories,
        'modes': modes_rows(measured, of_model),
        'periodicity': '\n'.join(f'- {t}' for t in tested if t.suspicious),
        'usual': usual(tested),
        'noise': noise_by_group(tested),
    }
    args.out.write_text(TEXT.format(**page))
    report(f'wrote {args.out}')


def beside(share: float) -> str:
    """Say whether other programs took the processors; `share` of one is what was had."""
    return ', with less than one of them for itself: other work ran beside it' if share < 1 else ''


def count(model: LoopModel) -> int:
    """Return how many numbers a model has, but for the coordinates of its modes."""
    linear = model.linear
    arrays = (linear.b, linear.c, linear.d, model.e, model.h, model.f, model.g)
    # a mode may be turned and scaled, two numbers a block, without any change
    return sum(a.size for a in arrays) + int((model.mu != 0).sum())


def usual(tested: Sequence[Periodicity]) -> tuple[float, float]:
    fine = [t.difference for t in tested if not t.suspicious]
    return min(fine), max(fine)


def noise_by_group(tested: Sequence[Periodicity]) -> str:
    """Return the noise of one period at each amplitude, mean over the records that repeat."""
    fine: dict[str, list[float]] = {}
    for t in tested:
        of_group = fine.setdefault(t.name.partition(',')[0], [])
        if not t.suspicious:
            # a difference has the noise of two periods
            of_group.append(t.difference / np.sqrt(2))
    return ' / '.join(f'{np.mean(found):.1f}' for found in fine.values())


if __name__ == '__main__':
    main()
