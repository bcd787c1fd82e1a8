# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The swarm of the third step beside pyswarms and SciPy's differential evolution.

    .venv-bench/bin/python benchmarks/bench_peers_swarm.py [--quick]

All minimise the same cost in the same box: the weights of H for the triangle of the simulated
stage, reduced to its triangular factor.  The clock stops when a loss within 1 % of that of bounded
least squares is reached.  Peers get a cost that takes the whole population in one product and
stops them by itself at the very evaluation; ours looks every hundred iterations.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import partial
import logging

import alone  # noqa: F401 - one thread of BLAS
import numpy as np
from piezo_ident.excitation.program import Program
from piezo_ident.identification.prepare import excerpts_of, prepare
from piezo_ident.identification.solvers.least_squares import bounded_least_squares
from piezo_ident.identification.solvers.particle_swarm import particle_swarm, Quadratic
from piezo_ident.identification.step3_hysteresis import (
    even_thresholds,
    factorise,
    P1_BOX,
    P2_BOX,
    WEIGHT_BOX,
)
from piezo_ident.model.simulated_stage import SimulatedStage
from scipy.optimize import differential_evolution
from side_by_side import markdown, ratio, seconds, show, take_turns, Turn

#: operators of H, that at r = 0 included
OPERATORS = 10
#: loss over that of bounded least squares that counts as there
NEAR = 1.01
#: iterations after which a search has failed
MOST = 20_000


class _ReachedError(Exception):
    """Ends a peer's search where it has what it was to find."""


@dataclass(frozen=True, eq=False)
class Problem:
    """``|A x - y|^2`` in a box, and its least value there."""

    A: np.ndarray
    y: np.ndarray
    box: np.ndarray
    optimum: float
    optimum_time: float

    def loss(self, x: np.ndarray) -> float:
        """Return the loss of one point."""
        return float(np.sum((self.A @ x - self.y) ** 2))


def problem() -> Problem:
    """Return the third step of the identification of the paper's stage."""
    stage = SimulatedStage.load('paper')
    sequence = Program.load('identification').build(20_000.0)
    record = stage.play(sequence, np.random.default_rng(0))
    excerpts = excerpts_of(prepare([record]).runs, 'triangle')
    r = even_thresholds(max(float(np.ptp(e.u[e.use])) for e in excerpts), OPERATORS)
    R = factorise(excerpts, r, stage.model.dynamics.normalised(), stage.model.delay)
    inner = R[len(excerpts) :, len(excerpts) :]
    lower = np.concatenate([np.zeros(r.size), [-np.inf, -np.inf]])
    direct = partial(bounded_least_squares, inner, lower, np.full(lower.size, np.inf))
    solved = take_turns({'direct': lambda k: direct()}, 5, warm=['direct'])['direct']
    return Problem(
        A=inner[:, :-1].copy(),
        y=inner[:, -1].copy(),
        box=np.array([WEIGHT_BOX] * r.size + [P1_BOX, P2_BOX]),
        optimum=solved.results[0][1],
        optimum_time=solved.median,
    )


@dataclass(frozen=True)
class Found:
    """Loss reached over the optimum, and evaluations of the cost."""

    excess: float
    evaluations: int

    @property
    def there(self) -> bool:
        """Whether the search reached what it was to reach."""
        return self.excess <= NEAR


class Cost:
    """The cost of a population, in rows, for a peer."""

    def __init__(self, task: Problem) -> None:
        self.task, self.best, self.evaluations = task, np.inf, 0
        self._transposed = np.ascontiguousarray(task.A.T)

    def __call__(self, X: np.ndarray) -> np.ndarray:
        """Return the cost of points, shape (particles, n)."""
        e = X @ self._transposed - self.task.y
        f = np.einsum('ij,ij->i', e, e)
        self.evaluations += f.size
        self.best = min(self.best, float(f.min()))
        if self.best <= NEAR * self.task.optimum:
            raise _ReachedError
        return f

    def found(self) -> Found:
        """Return what has been found."""
        return Found(self.best / self.task.optimum, self.evaluations)


def ours(task: Problem, seed: int) -> Found:
    """Fly our swarm as the identification does."""
    A, y = task.A, task.y
    goal = NEAR * task.optimum
    result = particle_swarm(
        Quadratic(A.T @ A, A.T @ y, float(y @ y)),
        task.box[:, 0],
        task.box[:, 1],
        rng=np.random.default_rng(seed),
        maxiter=MOST,
        callback=lambda intermediate_result: task.loss(intermediate_result.x) <= goal,
    )
    return Found(task.loss(result.x) / task.optimum, result.nfev)


def pyswarms(task: Problem, seed: int) -> Found:
    """Fly a swarm of pyswarms on a ring, with the best settings found for it."""
    from pyswarms.single import LocalBestPSO

    # the package draws from NumPy's global state
    np.random.seed(seed)  # noqa: NPY002
    cost = Cost(task)
    swarm = LocalBestPSO(
        n_particles=40,
        dimensions=task.box.shape[0],
        options={'w': 0.6, 'c1': 1.7, 'c2': 1.7, 'k': 7, 'p': 2},
        bounds=(task.box[:, 0], task.box[:, 1]),
        bh_strategy='intermediate',
        static=True,
    )
    with contextlib.suppress(_ReachedError):
        swarm.optimize(cost, MOST, verbose=False)
    return cost.found()


def evolution(task: Problem, seed: int) -> Found:
    """Run SciPy's differential evolution, with the best settings found for it."""
    cost = Cost(task)
    # seed= is rng= from SciPy 1.15 on, and both take a generator
    generator = {'seed': np.random.default_rng(seed)}
    with contextlib.suppress(_ReachedError):
        differential_evolution(
            lambda X: cost(X.T),
            [tuple(pair) for pair in task.box],
            vectorized=True,
            updating='deferred',
            polish=False,
            maxiter=MOST // 4,
            tol=0.0,
            popsize=5,
            recombination=0.95,
            **generator,
        )
    return cost.found()


def _row(name: str, turn: Turn, base: Turn) -> list[str]:
    there = [found.there for found in turn.results]
    return [
        name,
        seconds(turn.median),
        ratio(turn.over(base)) if all(there) else f'more than {ratio(turn.over(base))}',
        f'{int(np.median([found.evaluations for found in turn.results])):,}',
        f'{sum(there)} of {len(there)}',
        f'{np.median([found.excess for found in turn.results]):.4g}',
    ]


def sections(quick: bool = False) -> list[tuple[str, str]]:
    """Return titles and texts."""
    logging.getLogger('pyswarms').setLevel(logging.CRITICAL)
    runs, task = 2 if quick else 7, problem()
    works = {
        'piezo_ident.identification.solvers.particle_swarm': partial(ours, task),
        'pyswarms, ring': partial(pyswarms, task),
        'scipy differential_evolution': partial(evolution, task),
    }
    base = next(iter(works))
    turns = take_turns(works, runs, warm=[base])
    heads = (
        'search',
        'median time',
        f'over `{base}`',
        'evaluations',
        'within 1 %',
        'loss over optimum, median',
    )
    table = markdown(heads, [_row(name, turn, turns[base]) for name, turn in turns.items()])
    text = f"""\
{task.box.shape[0]} parameters (condition number of the columns {np.linalg.cond(task.A):.0f}), 40
particles, {runs} paired turns with a seed each, at most {MOST:,} iterations. The clock stops
when the loss is within 1 % of what `scipy.optimize.lsq_linear` finds.

{table}

pyswarms has a static ring with k = 7, the best of some thirty settings. differential_evolution has
`popsize=5, recombination=0.95`, the best of ten, and is the better choice where an evaluation is
expensive.
Bounded least squares finds the optimum itself in {seconds(task.optimum_time)}."""
    return [('Swarm to the same loss', text)]


if __name__ == '__main__':
    show(sections)
