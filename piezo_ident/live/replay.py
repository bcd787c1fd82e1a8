# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Which topics of a bag are replayed under which names, and when each message is due."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from piezo_ident.common.errors import DataError
from piezo_ident.record.bags.read import carried_quantities, is_computed
from piezo_ident.record.bags.recover import Bag

__all__ = ['ReplayClock', 'chosen_topics']


def chosen_topics(
    bag: Bag, wanted: Sequence[str], resolve: Callable[[str], str]
) -> dict[str, str]:
    """
    Return under which name each chosen topic of a bag is replayed.

    A topic is found by its full name here, else by the end of its name, so that what was recorded
    in one namespace can be replayed in another, else by the quantity that its blocks carry.

    Parameters
    ----------
    bag : Bag
        An open bag.
    wanted : sequence of str
        Names of topics, relative or absolute.
    resolve : callable
        Gives the full name of a topic, by namespace and remaps.

    Returns
    -------
    dict of str to str
        Full name here by the name in the bag.

    Raises
    ------
    DataError
        When a topic is not in the bag, or more than one could be meant.
    """
    there = sorted({c.topic for c in bag.connections})
    chosen: dict[str, str] = {}
    for name in wanted:
        target = resolve(name)
        found = [t for t in there if t == target]
        if not found and not name.startswith(('/', '~')):
            found = [t for t in there if t.endswith(f'/{name}')]
            if not found and '/' not in name:
                carried = _carried(bag).items()
                found = [t for t, q in carried if q == name and not is_computed(t)]
        if not found:
            raise DataError(
                f'{bag.path}: no topic {name} in it; set topics to some of: '
                + (', '.join(there) or 'none')
            )
        if len(found) > 1:
            raise DataError(
                f'{bag.path}: several topics could be {name}: {", ".join(found)}; start the '
                'player in the namespace of one of them'
            )
        if chosen.setdefault(found[0], target) != target:
            raise DataError(f'{bag.path}: {found[0]} would be replayed twice; name it once')
    return chosen


def _carried(bag: Bag) -> dict[str, str]:
    try:
        return carried_quantities(bag)
    except DataError:
        return {}  # no samples in it: then by name alone


class ReplayClock:
    """
    The schedule of a replay: the original spacing, counted from its start so that it cannot drift.

    After a long delay only a few messages are caught up with, and the rest of the schedule moves:
    readers keep so many messages and no more.

    Parameters
    ----------
    rate : float
        How many times faster than the log times.
    stamp : int
        Log time of the first message [ns].
    now : float
        When that is due, on a monotonic clock [s].

    Attributes
    ----------
    slipped : float
        By how much the schedule was moved [s].

    Examples
    --------
    >>> clock = ReplayClock(2.0, 1_000_000_000, now=50.0)
    >>> clock.due(3_000_000_000)
    51.0
    """

    #: messages that may follow each other at once after a delay
    BURST = 8
    #: less than this is no delay [s]
    SLACK = 0.001

    def __init__(self, rate: float, stamp: int, now: float) -> None:
        self.rate = rate
        self.slipped = 0.0
        self._stamp = stamp
        self._start = now
        self._late = 0

    def due(self, stamp: int) -> float:
        """Return when the message with a log time [ns] is due."""
        return self._start + (stamp - self._stamp) * 1e-9 / self.rate

    def note(self, stamp: int, now: float) -> None:
        """Take note that the message with a log time is next, before waiting for its time."""
        delay = now - self.due(stamp)
        if delay < self.SLACK:
            # there is time to wait: whatever was late is caught up with
            self._late = 0
            return
        self._late += 1
        if self._late >= self.BURST:
            self._start += delay
            self.slipped += delay
            self._late = 0

    def change_rate(self, rate: float, stamp: int, now: float) -> None:
        """Go on at another rate, with this message due now."""
        self.rate, self._stamp, self._start, self._late = rate, stamp, now, 0
