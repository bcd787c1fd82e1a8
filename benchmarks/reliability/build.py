# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
One table of all that was tried: docs/reliability.md, from the rows that the studies write.

    python benchmarks/reliability/build.py

A study writes its own rows, a list of {what, how_often, result, command}, into
``docs/reliability/rows/<name>.json`` with `rows.write_rows`; the text around the table is here.
"""

from __future__ import annotations

from itertools import groupby
import json
from operator import itemgetter
import sys
from typing import Any

from rows import ROWS

PAGE = ROWS.parents[1] / 'reliability.md'
#: studies in the order of the table; any other comes behind
ORDER = ('safety', 'attack', 'netns', 'crash', 'soak')


def _cell(value: Any) -> str:
    return ' '.join(str(value).replace('|', '\\|').split())


def _rows() -> list[dict[str, Any]]:
    found = {path.stem: json.loads(path.read_text('utf-8')) for path in ROWS.glob('*.json')}
    names = sorted(found, key=lambda n: (ORDER.index(n) if n in ORDER else len(ORDER), n))
    return [row for name in names for row in found[name]]


HEAD = """# Reliability

This page lists, for whoever connects an amplifier, the attempts to break the drive, the graph and
the files, and their results.

*Made by `python benchmarks/reliability/build.py` from `docs/reliability/rows/`. The commands run
from the root of the sources, after `make test`, with `.venv` active.*

"""

TAIL = """
## The safety property

Whatever arrives on `voltage`, every voltage that is *applied* is a number within the limits and no
further from the voltage before than the slew allows. Where limits are moved, the voltage goes back
into them at the slew. Silence ends at rest by a ramp, a new stream is joined by a ramp, a second
publisher moves nothing. `benchmarks/reliability/safety.py` is the property as code. It holds while
the process of the amplifier lives ([My driver](driver.md)).

## Damaged files and kills

A file that the reader of its library refuses ends in one line that names the file. An effect
plug-in that cannot be imported is skipped with a warning. [Security](SECURITY.md) lists the
threats that remain.

An output is written as `.NAME.RANDOM.tmp` (`.new.RANDOM.tmp` in a report folder) and renamed when
it is whole. A killed process leaves such a file, which can be deleted, and the old output. An
unfinished sqlite3 bag is read from a copy in the folder for temporary files,
`piezo_ident_bag_RANDOM`.

## Two hosts

Both hosts need

    export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET
    export ROS_DOMAIN_ID=...                      # the same on both, and of no other graph
    export FASTRTPS_DEFAULT_PROFILES_FILE=$PWD/config/fastdds_two_hosts.xml

before any node starts. The file makes socket buffers of 4 MiB (raise `net.core.rmem_max` and
`net.core.wmem_max` to as much), and has a lost packet asked for again within 10 ms. A topic keeps
its last thousand blocks, five seconds in real time. A link that is down for longer loses
samples, every listener says how many, and no model is made where too much is missing.

## How long is long

Memory that grows with messages shows in two hours (1.4e8 samples) as in a week. The sample clock
t = k/fs stays exact to 2^53 ticks, 14,000 years. Not tried: a stage that drifts, leaks of Fast DDS
below the resolution of the slope, a clock of the machine that is set.
"""


def _tried(rows: list[dict[str, Any]]) -> str:
    """Return the attempts of one outcome and how often each; a subject that they share once."""
    subject = rows[0]['what'].partition(': ')[0] + ': '
    if len(rows) < 2 or not all(row['what'].startswith(subject) for row in rows):
        subject = ''
    each = (f'{row["what"].removeprefix(subject)} ({row["how_often"]})' for row in rows)
    return subject + '; '.join(each)


def page() -> str:
    """Return the page; attempts of one command with one outcome share a line."""
    lines = ['| what was tried (how often) | what happened | command |', '|---|---|---|']
    for (happened, command), rows in groupby(_rows(), itemgetter('result', 'command')):
        cells = (_tried(list(rows)), happened, f'`{command}`')
        lines.append(f'| {" | ".join(map(_cell, cells))} |')
    return HEAD + '\n'.join(lines) + '\n' + TAIL


def main() -> int:
    """Write the page."""
    PAGE.write_text(page(), encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
