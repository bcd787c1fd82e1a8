# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Starts every node of an install space, sees it get up with its configuration, and ends it.

    . install/setup.bash && python .ci/installed_nodes.py install/piezo_ident
"""

from __future__ import annotations

import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import tempfile

#: states of a node that is up
UP = ('idle', 'waiting')
#: a node that has never run here compiles its kernels before it hears [s]
START_LIMIT, END_LIMIT = 60.0, 60.0


def see(client, space: Path, executable: str, log: Path) -> None:
    """Start a node, wait for its status, and end it."""
    command = [
        str(space / 'lib/piezo_ident' / executable),
        '--ros-args',
        '--params-file',
        str(space / f'share/piezo_ident/config/{executable}.yaml'),
    ]
    client.follow(executable)
    with log.open('wb') as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, cwd=log.parent)
    try:
        client.wait(
            lambda: client.status(executable).get('state') in UP or process.poll() is not None,
            START_LIMIT,
            executable,
        )
        process.send_signal(signal.SIGINT)
        code = process.wait(END_LIMIT)
    finally:
        process.kill()
    said = log.read_text(encoding='utf-8', errors='replace').strip()
    # the log of a node is no complaint
    said = '\n'.join(line for line in said.splitlines() if not line.startswith('[INFO]'))
    if code or said:
        sys.exit(f'{executable}: exit code {code}: {said}')
    sys.stdout.write(f'{executable}: {client.status(executable)["state"]}, exit code {code}\n')


def main() -> None:
    """See them all."""
    space = Path(sys.argv[1]).resolve()
    os.environ['ROS_DOMAIN_ID'] = str(random.SystemRandom().randint(1, 101))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    import piezo_ident

    if not Path(piezo_ident.__file__).is_relative_to(space):
        sys.exit(f'{piezo_ident.__file__} is not below {space}; source its setup first')
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'examples'))
    from lab_graph import Client
    from piezo_ident.nodes.parameters import NODES

    with tempfile.TemporaryDirectory() as folder, Client() as client:
        for executable in NODES:
            see(client, space, executable, Path(folder, f'{executable}.log'))


if __name__ == '__main__':
    main()
