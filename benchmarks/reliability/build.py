# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
One table of all that was tried: docs/reliability.md, from the rows that the studies write.

    python benchmarks/reliability/build.py

A study writes its own rows, a list of {what, how_often, result, command}, into
``docs/reliability/rows/<name>.json`` with `rows.write_rows`; the text around the table is here.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from rows import KEYS, ROWS

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

*Made by `python benchmarks/reliability/build.py` from `docs/reliability/rows/`; each study writes
its own rows. Every row can be run again with its command, from the root of the sources, after
`make test` (for `make crash` nothing before), with `.venv` active (`. .venv/bin/activate`).*

`make test` and `make test-graph` keep a fast subset of each row; `make attack`, `make netns`,
`make soak` and `make crash` run the whole.

## The table

"""

TAIL = """
## Files from strangers

A file is opened by the reader of its library: the csv module, NumPy, SciPy, rosbags, mcap, SQLite
and PyYAML. What these refuse ends in one line that names the file. SciPy reads MATLAB files in a
process of its own, since some damage ends it. No pickle is loaded from a file. YAML is read by the
safe loader, up to 500,000 characters and as many values; samples may unpack to 8 GiB
(`piezo_ident/common/files.py`). [SECURITY.md](SECURITY.md) says what is not kept off.

An effect plug-in is code that somebody installed; it can do what any program can. One that cannot
be imported is skipped with a warning.

## What a kill leaves behind

An output is written under the name `.NAME.RANDOM.tmp` in the same folder (`.new.RANDOM.tmp` in a
report folder) and renamed when it is whole; a bag that replaces another changes places with it in
one step. A process that is killed leaves such a name, which can be deleted, and what stood there
before. A report is several files: they are put in place one by one, the page last, so that a kill
in between leaves some of the old and some of the new, each whole. An unfinished sqlite3 bag, and a
compressed file of a bag, are read from a copy in the folder for temporary files,
`piezo_ident_bag_RANDOM`.

## The safety property

Whatever arrives on `voltage`, every voltage that is *applied* is a number within the limits and no
further from the one before than the slew allows; where limits are moved, it goes back into them at
the slew. Silence ends at rest by a ramp, a new stream is joined by one, a second publisher moves
nothing.

`benchmarks/reliability/safety.py` has it as code; `test/live/test_safety_property.py` tries some
of it in every `make test`, and the runs of the graph in this table check it on `applied_voltage`.
It holds while the process that drives the amplifier lives and its converter keeps its last value
when it dies: against SIGKILL and power failure only a watchdog in the amplifier helps
([driver.md](driver.md)).

## Two hosts

DDS finds its peers on other hosts by multicast. Where that is kept to the local machine
(`ROS_AUTOMATIC_DISCOVERY_RANGE`, see [SECURITY.md](SECURITY.md)), both hosts need

    export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET
    export ROS_DOMAIN_ID=...                      # the same on both, and of no other graph
    export FASTRTPS_DEFAULT_PROFILES_FILE=$PWD/config/fastdds_two_hosts.xml

before any node starts. The file makes socket buffers of 4 MiB, so that a burst of blocks survives
a busy receiver (raise `net.core.rmem_max` and `net.core.wmem_max` to as much), and has a lost
packet asked for again within 10 ms instead of seconds. That matters: a topic keeps its last
thousand blocks, five seconds in real time, and what is asked for later is gone. A link that is
down for longer, or a machine too busy to answer, therefore loses samples, every listener says how
many, and no model is made of what is left where too much is missing. A call of a service may go
unanswered on such a link too: ~/run then ends with that reason.

## How long is long

Two hours at 20 kHz are 1.4e8 samples. They stand for a week where nothing but time differs: memory
that grows with messages shows in two hours as it does in a week (the slope is in the table), the
sample clock is counted from its start and not summed up, so its rounding does not grow
(t = k/fs stays exact to 2^53 ticks, 14,000 years), and a recording is cut into parts. They do not
stand for a week where the world changes: a disk fills, temperature and stage drift, somebody sets
the clock of the machine (log times then go on as before; a test does it to a made-up clock), Fast
DDS and the kernel are not watched for leaks below the slope's resolution, and t loses digits in
text (a CSV needs 11 of them after a day).
"""


def page() -> str:
    """Return the page."""
    lines = ['| what was tried | how often | what happened | command |', '|---|---|---|---|']
    for row in _rows():
        cells = [_cell(row[key]) for key in KEYS]
        cells[-1] = f'`{cells[-1]}`'
        lines.append('| ' + ' | '.join(cells) + ' |')
    return HEAD + '\n'.join(lines) + '\n' + TAIL


def main() -> int:
    """Write the page."""
    PAGE.write_text(page(), encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
