# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The page of the demo: pictures of the motions, the bag, and what leads on from there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
import functools
import json
from pathlib import Path
import shlex
import sys

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
import piezo_ident as pi
from piezo_ident.report.figures import style
from piezo_ident.report.html import FileLink, Page, page_html, Section, Shown, Step
from piezo_ident.report.table import number, Table

ROOT = Path(__file__).resolve().parents[1]
STAGE = 'effects'
MOTIONS = Path(__file__).with_name('demo_program.yaml')
#: free runs of one model on one record are the same up to here, in strokes: rounding
SAME = 1e-12
#: of the motions, those whose last period is drawn as a loop, and their frequency [Hz]
LOOPS = (('sine:1Hz', 1.0), ('sine:120Hz', 120.0))
#: of the fastest one, so many periods are drawn over time
PERIODS = 3
BEFORE, AFTER, ESTIMATE = style.VERMILION, style.BLUE, style.GREEN

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Motion:
    """
    The motions as the stage made them, as a model predicted and as it estimated them, in s, V, m.

    The estimate is NaN where there is none.
    """

    t: Array
    v: Array
    y: Array
    y_hat: Array
    estimate: Array

    @property
    def residual(self) -> Array:
        """Measured - predicted [m]."""
        return self.y - self.y_hat

    @property
    def left(self) -> Array:
        """Measured - estimated [m]."""
        return self.y - self.estimate

    @property
    def stroke(self) -> float:
        """Largest - smallest displacement [m]."""
        return float(np.ptp(self.y))

    @property
    def text(self) -> str:
        """The residual for people."""
        return self._text(self.residual)

    @property
    def estimate_text(self) -> str:
        """The error of the estimate for people."""
        return self._text(self.left[np.isfinite(self.left)])

    def _text(self, error: Array) -> str:
        rms = float(np.sqrt(np.mean(error**2)))
        size, spread = 1e9 * rms, 1e9 * float(np.std(error))
        percent = 100.0 * rms / self.stroke
        return f'{size:.0f} nm ({percent:.3f} % of stroke), {spread:.0f} nm without its mean'


@dataclass(frozen=True, eq=False)
class Recorded:
    """
    What was recorded and replayed.

    Attributes
    ----------
    bag : path
    model : path
        Of the model that predicted.
    blocks : mapping of str to (int, int, bool)
        Blocks and samples in the bag by topic, and whether they are those on the wire, bit for
        bit.
    differences : mapping of str to float
        Largest difference between two free runs, in strokes; infinite where samples are missing.
    rate : float
        How many times faster than real time the bag was replayed.
    stroke : float
        Of the motions [m].
    commands : sequence of str
        What was asked of the nodes, as commands of ROS.
    lost : str
        Which samples a busy machine lost, so that nothing can be compared; empty for none.
    """

    bag: Path
    model: Path
    blocks: Mapping[str, tuple[int, int, bool]]
    differences: Mapping[str, float]
    rate: float
    stroke: float
    commands: Sequence[str]
    lost: str = ''

    @property
    def verdict(self) -> str:
        """By how much the free runs differ, or why nobody can say."""
        if self.lost:
            return f'cannot be compared: this machine lost {self.lost}'
        return f'differ by {max(self.differences.values()):.2g} of stroke'

    @property
    def problems(self) -> list[str]:
        """What is not as it should be, though nothing was lost."""
        if self.lost:
            return []
        altered = [topic for topic, (_, _, equal) in self.blocks.items() if not equal]
        return [f'{topic}: the bag differs from the wire' for topic in altered] + [
            f'the free runs {which} differ by {difference:.2g} of stroke'
            for which, difference in self.differences.items()
            if not difference <= SAME
        ]


@dataclass(frozen=True, eq=False)
class Session:
    """All that happened; `recorded` is None without nodes, and `remark` says why."""

    before: Motion
    after: Motion
    recorded: Recorded | None = None
    remark: str = ''

    @property
    def problems(self) -> list[str]:
        """What of the recording is not as it should be."""
        return self.recorded.problems if self.recorded else []


# pictures


def _parts() -> dict[str, tuple[float, float]]:
    """Return begin and end of each segment of the motions [s]."""
    motions = pi.Program.load(MOTIONS).build()
    rate = motions.sample_rate
    return {s.label: (s.start / rate, s.stop / rate) for s in motions.segments}


def _last_periods(motion: Motion, label: str, frequency: float, periods: int = 1) -> slice:
    end = _parts()[label][1]
    first, last = np.searchsorted(motion.t, (end - periods / frequency, end))
    # one more, which closes a loop
    return slice(int(first), int(last) + 1)


def loops_figure(before: Motion, after: Motion) -> Figure:
    """Draw displacement over voltage, measured and predicted, and what is missed below."""
    fig = style.figure(5.0)
    axes = fig.subplots(2, len(LOOPS), sharex=True, gridspec_kw={'height_ratios': [1.8, 1]})
    for (loops, errors), (label, frequency) in zip(axes.T, LOOPS, strict=True):
        part = _last_periods(after, label, frequency)
        loops.plot(after.v[part], 1e6 * after.y[part], color=style.COLOURS['under'], linewidth=4.0)
        loops.plot(after.v[part], 1e6 * after.y_hat[part], color=AFTER, linewidth=1.0)
        for motion, colour in ((before, BEFORE), (after, AFTER)):
            part = _last_periods(motion, label, frequency)
            errors.plot(motion.v[part], 1e9 * motion.residual[part], color=colour, linewidth=0.7)
        style.tidy(loops, '', '', f'{frequency:g} Hz')
        style.tidy(errors, 'voltage / V')
        errors.axhline(0.0, color=style.ZERO, linewidth=0.6, zorder=1)
    axes[0, 0].set_ylabel('displacement / µm', fontsize=style.NORMAL)
    axes[1, 0].set_ylabel('residual / nm', fontsize=style.NORMAL)
    _key(fig)
    return fig


def traces_figure(after: Motion) -> Figure:
    """Draw voltage and displacement, measured and predicted, over time."""
    fig = style.figure(4.0)
    axes = fig.subplots(2, 2, sharex='col', sharey='row', width_ratios=[2, 1])
    fast = _last_periods(after, *LOOPS[-1], PERIODS)
    for (top, bottom), part in zip(axes.T, (slice(None), fast), strict=True):
        t = after.t[part] if part == slice(None) else 1e3 * (after.t[part] - after.t[part][0])
        style.line(top, t, after.v[part], style.COLOURS['measured'])
        style.line(bottom, t, 1e6 * after.y[part], style.COLOURS['under'], linewidth=4.0)
        style.line(bottom, t, 1e6 * after.y_hat[part], AFTER)
        for each in (top, bottom):
            style.tidy(each)
            each.margins(x=0.01)
    style.tidy(axes[0, 0], '', 'voltage / V', 'all motions')
    style.tidy(axes[0, 1], '', '', f'{LOOPS[-1][1]:g} Hz, {PERIODS} periods')
    style.tidy(axes[1, 0], 'time / s', 'displacement / µm')
    style.tidy(axes[1, 1], 'time / ms')
    fig.align_ylabels(list(axes[:, 0]))
    _key(fig, residuals=False)
    return fig


def residual_figure(before: Motion, after: Motion) -> Figure:
    """Draw the residual over time, before and after, and the error of the estimate."""
    fig = style.figure(3.2)
    axes = fig.subplots()
    errors = ((before, before.residual, 'before', BEFORE), (after, after.residual, 'after', AFTER))
    for motion, e, label, colour in (*errors, (after, after.left, 'estimate', ESTIMATE)):
        style.line(axes, motion.t, 1e9 * e, colour, label, linewidth=0.8)
    style.tidy(axes, 'time / s', 'residual / nm')
    axes.axhline(0.0, color=style.ZERO, linewidth=0.6, zorder=1)
    style.percent_axis(axes, 1e9 * after.stroke)
    for label, (begin, end) in _parts().items():
        if not label.startswith(('idle', 'ramp')):
            axes.axvline(begin, color=style.COLOURS['band'], linewidth=0.8, zorder=1)
            style.name_above(axes, label, 0.5 * (begin + end))
    axes.margins(x=0.01)
    style.legend(axes, loc='lower center', ncols=3)
    return fig


def _key(fig: Figure, residuals: bool = True) -> None:
    """Say above all axes who is drawn how."""
    names = [('measured', style.COLOURS['under'], 4.0), ('predicted, after', AFTER, 1.2)]
    names += [('residual before', BEFORE, 1.2), ('residual after', AFTER, 1.2)] * residuals
    lines = [fig.axes[0].plot([], [], color=c, linewidth=w)[0] for _, c, w in names]
    fig.legend(
        lines,
        [n for n, *_ in names],
        loc='outside upper center',
        ncols=4,
        frameon=False,
        fontsize=style.SMALL,
    )


@functools.cache
def pictures(before: Motion, after: Motion) -> Mapping[str, bytes]:
    """Draw the pictures of the page, which may be done before it is written."""
    return {
        'loops': style.png(loops_figure(before, after)),
        'traces': style.png(traces_figure(after)),
        'residual': style.png(residual_figure(before, after)),
    }


# the page


def _motion_parts(session: Session) -> Iterable[Section]:
    before, after = session.before, session.after
    drawn = pictures(before, after)
    live = session.recorded is not None
    who = 'the model node, live' if live else 'the model'
    yield Section(
        'Measured and predicted',
        [
            Shown(
                'loops',
                'Loops',
                f'Displacement over voltage, measured and predicted by {who}, with the effects '
                'that the diagnosis added. Below: measured - predicted of the same motions, '
                'before and after the diagnosis.',
                drawn['loops'],
            ),
            Shown(
                'traces',
                'Over time',
                'The motions and three periods of the fastest.',
                drawn['traces'],
            ),
        ],
    )
    yield Section(
        'The residual before and after',
        [
            Table(
                'Residual of the same motions, rms',
                ('', 'residual'),
                [
                    ('before the diagnosis', before.text),
                    ('after it', after.text),
                    ('of the estimate after it', after.estimate_text),
                ],
            ),
            Shown(
                'residual',
                'The residual',
                'What the model misses, before and after the diagnosis, and what its estimate '
                'misses. ' + (NOTE if live else 'What remains is the noise of the sensor.'),
                drawn['residual'],
            ),
        ],
    )


#: below the residual of the running graph
NOTE = """What remains of the prediction is slow: creep of earlier motions, unknown to a free run
that begins at rest. The estimate corrects it by displacement that is at least 100 samples old."""


def _played(commands: Sequence[str]) -> Section:
    motions = pi.Program.load(MOTIONS).build().describe()
    steps = [Step(f'the motions, {MOTIONS.name} (begin, length, segment, voltages)', motions)]
    if commands:
        steps.append(Step('asked of the nodes, as commands of ROS', '\n'.join(commands)))
    return Section('What was played', steps)


def _bag(recorded: Recorded) -> Section:
    return Section(
        'The bag',
        [
            Table(
                f'{recorded.bag}, written by the recorder node',
                ('topic', 'blocks', 'samples', 'bag and wire'),
                [
                    (topic, str(n), str(samples), 'equal bit for bit' if equal else 'differ')
                    for topic, (n, samples, equal) in recorded.blocks.items()
                ],
                'The wire is what this program received from the same topics.',
            ),
            Table(
                'Free run from rest: the same model on the same motions',
                ('', 'largest difference / m', 'in strokes'),
                [(which, *_difference(recorded, which)) for which in recorded.differences],
                f'Live is the model node beside the stage. Replayed is a second model node in the '
                f'namespace /replay, to which the player sent the bag {recorded.rate:g} times as '
                f'fast as it was recorded. Offline is the model without nodes on the voltage in '
                f'the bag. Up to {SAME:g} of stroke counts as the same.',
            ),
        ],
    )


def _difference(recorded: Recorded, which: str) -> tuple[str, str]:
    value = recorded.differences[which]
    return number(value * recorded.stroke), number(value)


def _look_again(recorded: Recorded) -> list[Step]:
    bag, model = (shlex.quote(str(p)) for p in (recorded.bag, recorded.model))
    layout = shlex.quote(str(ROOT / 'config' / 'plotjuggler.xml'))
    nodes = shlex.quote(str(Path(sys.executable).parent))
    file = next(recorded.bag.glob('*.mcap'), recorded.bag)
    there = '--ros-args -r __ns:=/replay'
    return [
        Step(
            'the bag in PlotJuggler (docs/plots.md)',
            f'ros2 run plotjuggler plotjuggler --layout {layout} '
            f'--datafile {shlex.quote(str(file))}',
        ),
        Step(
            'the replay once more, each line in a shell of its own',
            f'export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST      # first, in each\n'
            f'{nodes}/model {there} -p model:={model}\n'
            f'{nodes}/player {there} -p bag:={bag} -p rate:={recorded.rate} -p autostart:=true',
        ),
        Step(
            'offline: predict estimates the creep that earlier motions have left, so it errs less',
            f'{nodes}/piezo_ident predict {model} {bag} --out predicted.csv',
        ),
    ]


def write_page(out: Path, session: Session, lines: Sequence[str]) -> Path:
    """Write the page that leads to the rest, and return its path."""
    diagnosis = json.loads((out / 'reports/diagnosis/diagnosis.json').read_text('utf-8'))
    error = diagnosis['error']
    facts = [
        (f'{when} the diagnosis, on held-out data', f'{error[when]["overall"]:.3g} % of stroke')
        for when in ('before', 'after')
    ]
    recorded = session.recorded
    facts.append(('estimate of the last motions', session.after.estimate_text))
    if recorded is not None:
        facts.append(('free run live, replayed, offline', recorded.verdict))
    links = {
        'reports/report.html': 'The identification: delay, dynamics, hysteresis, their errors',
        'reports/diagnosis/report.html': 'The diagnosis: residual, candidates, effects added',
        'reports/model.yaml': 'The model as identified',
        'reports/diagnosis/model.yaml': 'The model with the effects that were added',
    }
    bag = [] if recorded is None else [_bag(recorded)]
    again = [] if recorded is None else [Section('Look again', _look_again(recorded))]
    page = Page(
        title='A stage with effects that nobody declared',
        source='The simulated stage creeps, and its hysteresis depends on the rate. '
        + (
            'The nodes ran as processes over DDS at 20 kHz. '
            if recorded
            else session.remark + '. '
        )
        + 'The model that is identified from voltage and displacement knows neither effect; the '
        'diagnosis finds what it lacks.',
        headline=diagnosis['sentence'],
        facts=facts,
        before=[],
        sections=[
            *_motion_parts(session),
            *bag,
            _played(recorded.commands if recorded else ()),
            *again,
            Section('Read on', [FileLink(href, text) for href, text in links.items()]),
            Section('What happened', [Step('seconds since the start', '\n'.join(lines))]),
        ],
        after=[],
        footer='Errors are free-run errors, 100 rms(y - y_hat) / (max y - min y) in % of stroke.',
    )
    target = out / 'index.html'
    target.write_text(page_html(page), encoding='utf-8')
    return target
