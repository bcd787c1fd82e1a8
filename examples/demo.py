# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Identify a simulated stage on the running graph, and find the effects that nobody declared.

    python examples/demo.py --out demo_report

Four nodes run as processes over DDS.  The stage creeps and its hysteresis depends on the rate; the
model of the paper knows neither.  ``~/run`` identifies the stage, ``~/diagnose`` finds what the
model lacks, and the same motions before and after show the difference.  Without ROS the same is
done offline.  Either way ``index.html`` is the page to open first.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from html import escape
import json
import math
from pathlib import Path
import shutil
import sys
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
import piezo_ident as pi
from tqdm import tqdm

try:
    from lab_graph import Client, Nodes, own_domain
    from piezo_ident.nodes.wire import STREAM
    from std_msgs.msg import Float64MultiArray

    WITHOUT_NODES = ''
except ImportError as error:
    WITHOUT_NODES = f'the nodes cannot run here ({error}); the same follows offline'

STAGE = 'effects'
MOTIONS = Path(__file__).with_name('demo_program.yaml')
#: of the reports, what the first page shows, with its caption
PICTURES = {
    'diagnosis/signature.png': 'What the residual depends on, before and after: creep is the '
    'curve over the time since a step.',
    'loops.png': 'Hysteresis loops of the stage and of the model as identified.',
}
#: steps and their time on two quiet cores [s], which the progress bar goes by
STEPS = {
    'start': 5,
    'excitation': 17,
    'identification': 4,
    'motions': 9,
    'diagnosis': 15,
    'the same motions': 9,
    'reports': 8,
}
#: of the states of the identifier, those that are a step of their own
STATES = {
    'exciting': 'excitation',
    'identifying': 'identification',
    'diagnosing': 'diagnosis',
    'saving': 'reports',
}
FAILED = ('failed', 'cancelled', 'refused', 'stopped')
#: of the sample clock, in times real time
REAL_TIME, SLOW = 1.0, 0.25
#: a stream that is silent for so long has ended [s]
QUIET = 10.0


class Progress:
    """One bar over all steps on a terminal, a line a step everywhere; the lines are kept."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._begin = time.monotonic()
        self._bar = tqdm(
            total=sum(STEPS.values()),
            bar_format='{desc:18s}{percentage:3.0f}% |{bar}| {elapsed}',
            leave=False,
            disable=None,  # where standard error is no terminal
        )

    def show(self, step: str, share: float) -> None:
        """Show how much of a step is done."""
        before = list(STEPS).index(step)
        self._bar.n = sum(list(STEPS.values())[:before]) + STEPS[step] * min(max(share, 0.0), 1.0)
        self._bar.set_description_str(step)

    def say(self, text: str) -> None:
        """Print a line, with the time since the start."""
        self.lines.append(f'{time.monotonic() - self._begin:4.0f} s  {text}')
        tqdm.write(self.lines[-1], file=sys.stdout)

    def close(self) -> None:
        """Take the bar away."""
        self._bar.close()


@dataclass(frozen=True, eq=False)
class Residual:
    """The residual of a motion."""

    t: NDArray[np.float64]  # [s]
    r: NDArray[np.float64]  # [m]
    stroke: float  # [m]

    @property
    def rms(self) -> float:
        """Root mean square [m]."""
        return float(np.sqrt(np.mean(self.r**2)))

    @property
    def text(self) -> str:
        """The rms for people."""
        size, spread = 1e9 * self.rms, 1e9 * float(np.std(self.r))
        percent = 100.0 * self.rms / self.stroke
        return f'{size:.0f} nm ({percent:.3f} % of stroke), {spread:.0f} nm without its mean'


@dataclass
class Streams:
    """What passes on `residual` and `displacement`."""

    blocks: list[NDArray[np.float64]] = field(default_factory=list)
    low: float = np.inf
    high: float = -np.inf
    arrival: float = 0.0

    def on_residual(self, message: Any) -> None:
        """Keep a block."""
        self.blocks.append(np.array(message.data).reshape(-1, 2))
        self.arrival = time.monotonic()

    def on_displacement(self, message: Any) -> None:
        """Keep the range."""
        y = np.array(message.data)[1::2]
        self.low, self.high = min(self.low, y.min()), max(self.high, y.max())

    def residual(self) -> Residual:
        """Return what was kept."""
        rows = np.concatenate(self.blocks) if self.blocks else np.zeros((1, 2))
        return Residual(rows[:, 0], rows[:, 1], self.high - self.low)


class Lab:
    """The running graph."""

    def __init__(self, nodes: Nodes, client: Client, out: Path, progress: Progress) -> None:
        self.nodes, self.client, self.out, self.progress = nodes, client, out, progress
        self.rate = REAL_TIME
        self.streams = Streams()
        self.reports = client.listen('report')
        for topic in ('residual', 'displacement'):
            callback = getattr(self.streams, f'on_{topic}')
            client.node.create_subscription(Float64MultiArray, topic, callback, STREAM)

    def start(self) -> None:
        """Start the nodes; no limit is one that a slow machine meets."""
        names = ('stage', 'identifier', 'model', 'excitation')
        self.client.follow(*names)
        parameters = {
            'stage': {'stage': STAGE, 'silence': 30.0},
            'identifier': {'output': str(self.out / 'reports'), 'excitation_limit': 300.0},
            'excitation': {'subscribers': 3, 'wait_limit': 300.0},
        }
        for name in names:
            self.nodes.start(name, parameters=parameters.get(name))
        for i, name in enumerate(names):
            self.progress.show('start', i / len(names))
            self.wait(lambda name=name: self.client.status(name), name)
        self.progress.say(f'four nodes are running: {", ".join(names)}')

    def ask(self, service: str) -> None:
        """Call a service that must not refuse."""
        # what follows the call must not be mistaken for what was before
        self.client.forget(service.rpartition('/')[0])
        accepted, message = self.client.call(service)
        if not accepted:
            raise pi.PiezoIdentError(f'{service}: {message}')

    def set(self, name: str, value: Any) -> None:
        """Set a parameter of the excitation."""
        accepted, reason = self.client.set('excitation', name, value)
        if not accepted:
            raise pi.PiezoIdentError(f'excitation: {name}: {reason}')

    def wait(
        self, condition: Callable[[], Any], what: str, look: Callable[[], None] | None = None
    ) -> None:
        """Wait as long as the nodes live."""
        self.client.wait(condition, math.inf, what, look or self.nodes.check)

    def call(self, service: str, step: str) -> None:
        """Call a service, and show the progress of its node until it is done."""
        node = service.rpartition('/')[0]
        self.ask(service)

        def look() -> None:
            self.nodes.check()
            status = self.client.status(node)
            state = status.get('state', '')
            if state in FAILED:
                raise pi.PiezoIdentError(f'{node}: {status["message"]}')
            self.progress.show(STATES.get(state, step), float(status.get('progress', 0)) / 100)

        self.wait(lambda: self.client.status(node).get('state') == 'done', step, look)

    def call_for_report(self, service: str, step: str) -> dict[str, Any]:
        """Call a service, and return the report that it ends with."""
        n = len(self.reports)
        self.call(service, step)
        self.wait(lambda: len(self.reports) > n, 'the report')
        return dict(json.loads(self.reports[-1]))

    def without_loss(self, step: Callable[[], tuple[Any, str]]) -> Any:
        """Do a step in real time, and where samples are lost once more at a quarter of it."""
        while True:
            try:
                result, lost = step()
            except pi.PiezoIdentError as error:
                self.nodes.check()
                if self.rate == SLOW:
                    raise
                lost = str(error)
            else:
                if lost and self.rate == SLOW:
                    self.progress.say(f'still lost: {lost}')
                if not lost or self.rate == SLOW:
                    return result
            self.progress.say(f'this machine is too busy for real time: {lost}')
            self.progress.say('once more at a quarter of the rate')
            if self.client.status('excitation').get('state') in ('waiting', 'running'):
                self.ask('excitation/stop')
            self.wait(
                lambda: self.client.status('excitation').get('state', 'done') in ('done', *FAILED),
                'the end of the excitation',
            )
            self.rate = SLOW
            self.set('rate_factor', SLOW)

    def identify(self) -> tuple[None, str]:
        """Have the identifier drive the stage and learn its model."""
        models = self.models()
        report = self.call_for_report('identifier/run', 'excitation')
        self.wait_for_model(models)
        message = self.client.status('identifier')['text'].partition(' (100')[0]
        self.progress.say(f'~/run identified the stage: {message}')
        return None, '; '.join(f'{x["name"]} {x["where"]}' for x in report['data_faults'])

    def diagnose(self) -> None:
        """Have the identifier find what the model lacks."""
        models = self.models()
        report = self.call_for_report('identifier/diagnose', 'diagnosis')
        self.progress.say(f'~/diagnose: {report["sentence"]}')
        if report['effects']:
            self.wait_for_model(models)

    def play(self, step: str) -> tuple[Residual, str]:
        """Play the motions, and return the residual on its topic, and what was lost of it."""
        self.ask('identifier/clear')
        self.set('program', str(MOTIONS))
        self.streams.blocks.clear()
        self.call('excitation/start', step)
        self.streams.arrival = time.monotonic()
        n = pi.Program.load(MOTIONS).build().n

        def is_over() -> bool:
            arrived = sum(len(block) for block in self.streams.blocks)
            return arrived >= n or time.monotonic() - self.streams.arrival > QUIET

        self.wait(is_over, 'the residual')
        residual = self.streams.residual()
        lost = n - residual.r.size
        self.progress.say(f'{step}: residual of the model {residual.text}')
        return residual, f'{lost} of {n} samples of the residual' if lost else ''

    def models(self) -> int:
        """Return how many models the model node has taken."""
        return int(self.client.status('model').get('models', 0))

    def wait_for_model(self, before: int) -> None:
        """Wait until the model node has taken another model."""
        self.wait(
            lambda: self.models() > before, 'the model node taking the model', self.nodes.check
        )


def live(out: Path, progress: Progress) -> tuple[Residual, Residual]:
    """Do it on the running graph; return the residual before and after."""
    own_domain()
    with Nodes(out / 'log') as nodes, Client('demo') as client:
        lab = Lab(nodes, client, out, progress)
        lab.start()
        lab.without_loss(lab.identify)
        before = lab.without_loss(lambda: lab.play('motions'))
        lab.diagnose()
        after = lab.without_loss(lambda: lab.play('the same motions'))
        lab.call('identifier/save', 'reports')
        for name, code in nodes.stop().items():
            if code:
                raise pi.PiezoIdentError(f'node {name} ended with code {code}')
    return before, after


def offline(out: Path, progress: Progress) -> tuple[Residual, Residual]:
    """Do the same without nodes; return the residual before and after."""
    stage, motions = pi.SimulatedStage.load(STAGE), pi.Program.load(MOTIONS)
    record, validation, again = (
        stage.play(program, np.random.default_rng(seed))
        for seed, program in enumerate((pi.Program.load('identification'), motions, motions))
    )

    def show(step: str) -> Callable[[str, float], None]:
        return lambda _, share: progress.show(step, share)

    identification = pi.identify(record, progress=show('identification'))
    percent = identification.headline.percent
    progress.say(f'identified: the model errs by {percent:.3g} % of stroke')
    before = _residual(identification.model, again)
    progress.say(f'motions: residual of the model {before.text}')
    diagnosis = pi.diagnose(identification.model, validation, progress=show('diagnosis'))
    progress.say(f'diagnosed: {diagnosis.sentence}')
    after = _residual(diagnosis.model, again)
    progress.say(f'the same motions: residual of the model {after.text}')
    progress.show('reports', 0.0)
    pi.write_report(identification, out / 'reports')
    pi.write_report(diagnosis, out / 'reports' / 'diagnosis')
    return before, after


def _residual(model: pi.StageModel, record: pi.Record) -> Residual:
    run = pi.free_run(model, record)
    t = np.concatenate([piece.t for piece in record])
    return Residual(t, run.measured - run.predicted, record.stroke)


#: below the residual of the running graph
NOTE = """What remains is slow: creep that earlier motions have left, which the model cannot know,
since it begins at rest with each stream."""
PAGE = """\
<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>piezo_ident: the demo</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
:root {{ color-scheme: light dark; --ink: #1a1a1a; --paper: #fff; --soft: #555; --back: #f1f6fa; }}
@media (prefers-color-scheme: dark) {{ :root {{ --ink: #e4e4e4; --paper: #17191c; --soft: #a9adb2;
  --back: #182936; }} a {{ color: #7ab8f5; }} }}
body {{ font: 16px/1.5 system-ui, 'Segoe UI', 'DejaVu Sans', sans-serif; color: var(--ink);
  background: var(--paper); max-width: 62rem; margin: 0 auto; padding: 1.5rem; }}
h1 {{ font-size: 1.6rem; margin: 0; }} h2 {{ font-size: 1.2rem; margin: 2rem 0 .5rem; }}
.verdict {{ font-size: 1.15rem; border-left: 4px solid #0072B2; background: var(--back);
  padding: .5rem .9rem; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; }}
th, td {{ padding: .25rem 1rem .25rem 0; text-align: left; border-bottom: 1px solid #ddd; }}
figure {{ margin: 1.2rem 0; overflow-x: auto; }}
img {{ display: block; background: #fff; width: 50rem; max-width: 100%; min-width: 32rem; }}
figcaption, footer {{ color: var(--soft); font-size: .9rem; }}
pre {{ background: var(--back); padding: .7rem; white-space: pre-wrap; font-size: .85rem; }}
</style></head><body>
<h1>A stage with effects that nobody declared</h1>
<p>{intro}</p>
<p class="verdict">{sentence}</p>
<table><tr><th></th><th>before</th><th>after</th></tr>{rows}</table>
<figure><img src="residual.png" alt="residual before and after">
<figcaption>What the model misses of the same motions, before and after the diagnosis.
{note}</figcaption>
</figure>
<h2>Read on</h2>
<ul>
<li><a href="reports/report.html">The identification</a>: delay, dynamics, hysteresis, their errors
and pictures</li>
<li><a href="reports/diagnosis/report.html">The diagnosis</a>: the residual, the candidates, the
effects that were added</li>
<li>models: <a href="reports/model.yaml">as identified</a>,
<a href="reports/diagnosis/model.yaml">refined</a></li>
<li>all pictures: {pictures}</li>
</ul>
{figures}
<h2>What happened</h2>
<pre>{lines}</pre>
<footer>Errors are free-run errors, 100 rms(y - y_hat) / (max y - min y) in % of stroke.</footer>
</body></html>
"""


def write_page(
    out: Path, before: Residual, after: Residual, live: bool, progress: Progress
) -> Path:
    """Write the page that leads to the rest, and return its path."""
    reports = out / 'reports'
    diagnosis = json.loads((reports / 'diagnosis' / 'diagnosis.json').read_text('utf-8'))
    error = diagnosis['error']
    rows = [('residual of the same motions, rms', before.text, after.text)]
    rows.append(
        (
            'free run on held-out data',
            *(f'{error[key]["overall"]:.3g} % of stroke' for key in ('before', 'after')),
        )
    )
    pictures = sorted(p.relative_to(out).as_posix() for p in reports.rglob('*.png'))
    page = out / 'index.html'
    text = PAGE.format(
        intro=escape(
            'The simulated stage creeps, and its hysteresis depends on the rate; the graph '
            f'{"ran as four processes over DDS at 20 kHz" if live else "was not needed"}. The '
            'model that is identified from voltage and displacement knows neither effect; the '
            'diagnosis finds what it lacks.'
        ),
        sentence=escape(diagnosis['sentence']),
        note=NOTE if live else '',
        rows=''.join(
            f'<tr><td>{escape(a)}</td><td>{escape(b)}</td><td>{escape(c)}</td></tr>'
            for a, b, c in rows
        ),
        pictures=', '.join(f'<a href="{p}">{escape(Path(p).stem)}</a>' for p in pictures),
        figures=''.join(
            f'<figure><img src="reports/{name}" alt=""><figcaption>{caption}</figcaption></figure>'
            for name, caption in PICTURES.items()
            if (reports / name).is_file()
        ),
        lines=escape('\n'.join(progress.lines)),
    )
    page.write_text(text, encoding='utf-8')
    return page


def draw(path: Path, before: Residual, after: Residual) -> None:
    """Draw the residual before and after."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.6), layout='constrained')
    axes = figure.subplots()
    for residual, label, colour in ((before, 'before', '#D55E00'), (after, 'after', '#0072B2')):
        axes.plot(residual.t, 1e9 * residual.r, color=colour, label=label, linewidth=0.8)
    axes.set(xlabel='t / s', ylabel='residual / nm')
    axes.legend(frameon=False)
    axes.spines[['top', 'right']].set_visible(False)
    figure.savefig(path, dpi=150)


def main() -> int:
    """Run the demo."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--out', type=Path, default=Path('demo_report'), metavar='DIR')
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(out / 'reports', ignore_errors=True)
    progress = Progress()
    try:
        if WITHOUT_NODES:
            progress.say(WITHOUT_NODES)
            before, after = offline(out, progress)
        else:
            before, after = live(out, progress)
        draw(out / 'residual.png', before, after)
        page = write_page(out, before, after, not WITHOUT_NODES, progress)
    except pi.PiezoIdentError as error:
        progress.close()
        sys.stderr.write(f'demo: {error}\n')
        return 1
    except KeyboardInterrupt:
        progress.close()
        sys.stderr.write('demo: interrupted\n')
        return 130
    progress.close()
    sys.stdout.write(f'before: {before.text}\nafter:  {after.text}\nopen {page}\n')
    return 0


if __name__ == '__main__':
    sys.exit(main())
