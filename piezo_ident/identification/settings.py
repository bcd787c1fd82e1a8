# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Settings of an identification, and how it tells its progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any, get_args, Literal

from piezo_ident.common.errors import ConfigError, expect_numbers

Solver = Literal['least_squares', 'swarm', 'joint']
SOLVERS: tuple[str, ...] = get_args(Solver)
#: callback with the name of the step and its share done; it raises `Cancelled` to stop
Progress = Callable[[str, float], None]


def silent(step: str, share: float) -> None:
    """Report no progress."""


@dataclass(frozen=True)
class Settings:
    """
    Settings of an identification.

    Attributes
    ----------
    thresholds : int, optional
        Number of plays of H, including the play at r = 0, evenly spaced over the excited range.
        The paper takes ten.  By default, number and places are chosen by held-out error.
    solver : {'least_squares', 'swarm', 'joint'}
        Solver of the weights.  Least squares finds the optimum of this convex problem.  The swarm
        is the solver of the paper; `polish` replaces its weights.  The solver 'joint' fits delay,
        G and H in one step, as to a record without labels.
    polish : bool
        Let bounded least squares finish the fit of the swarm.
    max_order : int
        Largest na and nb of the search.
    order : tuple of int, optional
        Orders (na, nb); no search takes place.  Poles too slow for G still leave it.
    delay : int, optional
        Delay [samples]; no delay is fitted.
    swarm_size, swarm_iterations : int
        Number of particles, and most iterations.
    hold_out : float, optional
        Seconds at the end of an unlabelled record that are not fitted.  By default a fifth of the
        record in four stretches is not fitted.
    seed : int
        Seed of everything random.

    Raises
    ------
    ConfigError
        If a value is out of range.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> as_in_the_paper = pi.Settings(thresholds=10, solver='swarm')
    """

    thresholds: int | None = None
    solver: Solver = 'least_squares'
    polish: bool = False
    max_order: int = 15
    order: tuple[int, int] | None = None
    delay: int | None = None
    swarm_size: int = 40
    swarm_iterations: int = 20_000
    hold_out: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        expect_numbers(self)
        sizes: Any = self.order or (1, 1)
        rules = {
            'thresholds': (self.thresholds is None or 2 <= self.thresholds <= 400, '2 to 400'),
            'solver': (self.solver in SOLVERS, ' or '.join(SOLVERS)),
            'polish': (not self.polish or self.solver == 'swarm', "False without solver='swarm'"),
            'max_order': (1 <= self.max_order <= 50, '1 to 50'),
            'order': (
                isinstance(sizes, Sequence)
                and len(sizes) == 2
                and all(n in range(1, 51) and isinstance(n, Integral) for n in sizes),
                'two whole numbers of 1 to 50',
            ),
            'delay': (self.delay is None or 0 <= self.delay <= 10_000, '0 to 10000 samples'),
            'swarm_size': (self.swarm_size >= 2, 'at least 2'),
            'swarm_iterations': (self.swarm_iterations >= 1, 'positive'),
            'hold_out': (
                self.hold_out is None or 0.0 < self.hold_out < float('inf'),
                'a positive time [s]',
            ),
            'seed': (self.seed >= 0, 'zero or positive'),
        }
        for name, (is_valid, wanted) in rules.items():
            if not is_valid:
                raise ConfigError(f'{name} must be {wanted}, got {getattr(self, name)!r}')
