# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Identify a simulated stage on the running graph, and find the effects that nobody declared.

    python examples/demo.py --out demo_report

Five nodes run as processes over DDS.  The stage creeps and its hysteresis depends on the rate; the
model of the paper knows neither.  ``~/run`` identifies the stage, ``~/diagnose`` finds what the
model lacks, and the same motions before and after show the difference.  The recorder writes the
motions to a bag, and the player replays it to a second model node.  Without ROS the same is done
offline, but for the bag.  Either way ``index.html`` is the page to open first.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
import shutil
import sys
import time

from demo_page import Motion, MOTIONS, Session, STAGE, write_page
import numpy as np
import piezo_ident as pi
from tqdm import tqdm

try:
    from demo_graph import live

    WITHOUT_NODES = ''
except ImportError as error:
    WITHOUT_NODES = f'the nodes cannot run here ({error}); the same follows offline'

#: steps and their time on two quiet cores [s], which the progress bar goes by
STEPS = {
    'start': 5,
    'excitation': 9,
    'identification': 4,
    'motions': 7,
    'diagnosis': 15,
    'the same motions': 7,
    'reports': 2,
    'replay': 4,
}


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


def offline(out: Path, progress: Progress) -> Session:
    """Do the same without nodes."""
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
    before = _motion(identification.model, again)
    progress.say(f'motions: residual of the model {before.text}')
    diagnosis = pi.diagnose(identification.model, validation, progress=show('diagnosis'))
    progress.say(f'diagnosed: {diagnosis.sentence}')
    after = _motion(diagnosis.model, again)
    progress.say(f'the same motions: residual of the model {after.text}')
    progress.show('reports', 0.0)
    pi.write_report(identification, out / 'reports')
    pi.write_report(diagnosis, out / 'reports' / 'diagnosis')
    return Session(before, after, remark=WITHOUT_NODES)


def _motion(model: pi.StageModel, record: pi.Record) -> Motion:
    run = pi.free_run(model, record)
    t, v = (np.concatenate([getattr(piece, name) for piece in record]) for name in ('t', 'v'))
    return Motion(t, v, run.measured, run.predicted, np.concatenate(run.estimate))


def main() -> int:
    """Run the demo."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--out', type=Path, default=Path('demo_report'), metavar='DIR')
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    for old in ('reports', 'bags'):
        shutil.rmtree(out / old, ignore_errors=True)
    progress = Progress()
    try:
        if WITHOUT_NODES:
            progress.say(WITHOUT_NODES)
        session = (offline if WITHOUT_NODES else live)(out, progress)
        page = write_page(out, session, progress.lines)
    except pi.PiezoIdentError as error:
        progress.close()
        sys.stderr.write(f'demo: {error}\n')
        return 1
    except KeyboardInterrupt:
        progress.close()
        sys.stderr.write('demo: interrupted\n')
        return 130
    progress.close()
    sys.stdout.write(f'before: {session.before.text}\nafter:  {session.after.text}\n')
    sys.stdout.write(f'estimate after: {session.after.estimate_text}\nopen {page}\n')
    for problem in session.problems:
        sys.stderr.write(f'demo: {problem}\n')
    return 1 if session.problems else 0


if __name__ == '__main__':
    sys.exit(main())
