# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The graph over two hosts, with a network between them that loses packets, or goes away.

    sudo .venv/bin/python benchmarks/reliability/netns.py

Stage and excitation run in one network namespace, identifier and model in another, with a pair of
virtual Ethernet devices between them.  A short program is run by ``~/run`` while none, 1 % or
5 % of the packets are dropped in both directions, and while the link is down for 10 s.  Every
sample arrives or its loss is reported; the model is the one of a perfect network, or refused.
Last, with discovery kept to the local machine, each host must see nothing of the other.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
import contextlib
from dataclasses import dataclass
import json
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

HERE = Path(__file__).resolve()
ROOT = HERE.parents[2]
sys.path[:0] = [str(HERE.parent), *(str(ROOT / x) for x in ('test', 'test/nodes', 'examples'))]
from course import PROGRAM

#: number in the text of a result
NUMBER = r'\d+(?:\.\d+)?'
PROFILES = ROOT / 'config/fastdds_two_hosts.xml'
SETTINGS = {'max_order': 6, 'swarm_iterations': 20_000, 'nice': 0}
#: what a run may take, and what a busy machine may add to the start of a node [s]
LIMIT = 90.0


def why_not() -> str:
    """Return why there can be no two hosts here, empty when there can."""
    if sys.platform != 'linux' or os.geteuid() != 0:
        return 'network namespaces need root on Linux'
    missing = [name for name in ('ip', 'nft') if shutil.which(name) is None]
    if missing:
        return f'{" and ".join(missing)} not found; install iproute2 and nftables'
    name = f'pi{os.getpid()}t'
    made = subprocess.run(['ip', 'netns', 'add', name], capture_output=True, text=True)
    if made.returncode:
        return f'ip netns add: {made.stderr.strip()}'
    try:
        rules = ['ip', 'netns', 'exec', name, 'nft', 'add', 'table', 'inet', 'probe']
        tried = subprocess.run(rules, capture_output=True, text=True)
    finally:
        subprocess.run(['ip', 'netns', 'del', name], check=True)
    return f'nft: {tried.stderr.strip()}' if tried.returncode else ''


class Hosts:
    """Two network namespaces with a link between them; nothing is left of them at the end."""

    def __init__(self, discovery: str = 'SUBNET') -> None:
        self.names = (f'pi{os.getpid()}a', f'pi{os.getpid()}b')
        self.processes: list[subprocess.Popen[str]] = []
        self.environment = {
            **os.environ,
            'PYTHONPATH': os.pathsep.join(
                filter(None, [str(ROOT), os.environ.get('PYTHONPATH', '')])
            ),
            'ROS_DOMAIN_ID': '7',  # no other graph is in these namespaces
            'ROS_AUTOMATIC_DISCOVERY_RANGE': discovery,
            'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROFILES),
        }

    def __enter__(self) -> Hosts:
        self.folder = Path(tempfile.mkdtemp(prefix='piezo_ident_hosts_'))
        self.environment['ROS_LOG_DIR'] = str(self.folder)
        one, other = self.names
        try:
            for name in self.names:
                _ip('netns', 'add', name)
                _ip('-n', name, 'link', 'set', 'lo', 'up')
            _ip(
                'link', 'add', 'veth', 'netns', one, 'type', 'veth', 'peer', 'veth', 'netns', other
            )
            for k, name in enumerate(self.names):
                _ip('-n', name, 'addr', 'add', f'10.77.0.{k + 1}/24', 'dev', 'veth')
                _ip('-n', name, 'link', 'set', 'veth', 'up')
                _ip('-n', name, 'route', 'add', '224.0.0.0/4', 'dev', 'veth')
        except BaseException:
            self._clean_up()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._clean_up()

    def _clean_up(self) -> None:
        for process in self.processes:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        for name in self.names:
            subprocess.run(['ip', 'netns', 'del', name], capture_output=True)
        shutil.rmtree(self.folder, ignore_errors=True)

    def start(self, host: int, command: Sequence[str], name: str) -> subprocess.Popen[str]:
        """Start a process on a host; what it writes goes into a file of its name."""
        with (self.folder / f'{name}.err').open('w') as err:
            process = subprocess.Popen(
                ['ip', 'netns', 'exec', self.names[host], *command],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=err,
                env=self.environment,
                text=True,
                start_new_session=True,
            )
        self.processes.append(process)
        return process

    def node(self, host: int, executable: str, parameters: Mapping[str, Any]) -> None:
        """Start a node on a host."""
        file = self.folder / f'{executable}.yaml'
        file.write_text(json.dumps({'/**': {'ros__parameters': dict(parameters)}}))
        code = f'from piezo_ident.nodes.main import start; start({executable!r})'
        arguments = ['--ros-args', '--params-file', str(file)] if parameters else ['--ros-args']
        self.start(host, [sys.executable, '-c', code, *arguments], executable)

    def drop(self, percent: int) -> None:
        """Drop so many of the packets that come in over the link, on both hosts."""
        rule = f'iifname "veth" numgen random mod 100 < {percent} counter drop'
        text = 'table inet lossy {\n chain lose {\n type filter hook input priority 0\n'
        text += f' {rule}\n }}\n}}\n' if percent else ' }\n}\n'
        for name in self.names:
            command = ['ip', 'netns', 'exec', name, 'nft', '-f', '-']
            subprocess.run(command, input=text, text=True, check=True)

    def dropped(self) -> int:
        """Return how many packets were dropped on both hosts."""
        count = 0
        for name in self.names:
            command = ['ip', 'netns', 'exec', name, 'nft', '-j', 'list', 'table', 'inet', 'lossy']
            found = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
            for part in found['nftables']:
                for what in part.get('rule', {}).get('expr', ()):
                    count += what.get('counter', {}).get('packets', 0)
        return count

    def link(self, up: bool) -> None:
        """Take the link down, or up again."""
        _ip('-n', self.names[0], 'link', 'set', 'veth', 'up' if up else 'down')
        if up:
            _ip('-n', self.names[0], 'route', 'replace', '224.0.0.0/4', 'dev', 'veth')


def leftover() -> list[str]:
    """Return the namespaces of this process that are still there."""
    listed = subprocess.run(['ip', 'netns', 'list'], capture_output=True, text=True).stdout
    return [line.split()[0] for line in listed.splitlines() if f'pi{os.getpid()}' in line]


def _ip(*arguments: str) -> None:
    made = subprocess.run(['ip', *arguments], capture_output=True, text=True)
    if made.returncode:
        raise RuntimeError(f'ip {" ".join(arguments)}: {made.stderr.strip()}')


@dataclass(frozen=True)
class Outcome:
    """
    What came of a run over two hosts.

    `state`, `message`: the identifier's last status; `sent`, `captured`: samples of the program,
    and those of both streams that the identifier got; `lost`: samples that the identifier says are
    missing, over all topics; `faults`: what the report names; `model`: YAML; empty when none was
    made; `dropped`: packets; `seconds`: from the call to the end.
    """

    state: str
    message: str
    sent: int
    captured: int
    lost: int
    faults: tuple[str, ...]
    model: str
    dropped: int
    seconds: float

    @property
    def is_honest(self) -> bool:
        """Whether all samples are there, or their loss is reported."""
        if self.state == 'done' and self.captured == self.sent:
            return True
        return bool(self.lost or self.faults) or (self.state == 'failed' and bool(self.message))


def run(percent: int = 0, down: float = 0.0) -> Outcome:
    """
    Run a program over two hosts.

    `percent`: of the packets that are dropped, in both directions; `down`: how long the link is
    down in the midst of it [s].
    """
    from piezo_ident.excitation.program import parse_program

    with Hosts() as hosts:
        hosts.drop(percent)
        hosts.node(0, 'stage', {'seed': 3, 'silence': 2.0})
        hosts.node(0, 'excitation', {'subscribers': 3, 'wait_limit': 60.0})
        hosts.node(1, 'identifier', SETTINGS)
        hosts.node(1, 'model', {})
        (hosts.folder / 'program.yaml').write_text(PROGRAM)
        command = [sys.executable, str(HERE), '--drive', str(hosts.folder / 'program.yaml')]
        driver = hosts.start(1, command, 'driver')
        assert driver.stdout is not None
        begun = driver.stdout.readline().strip()
        if begun == 'running' and down:
            hosts.link(up=False)
            time.sleep(down)
            hosts.link(up=True)
        text, _ = driver.communicate(timeout=2 * LIMIT + down)
        if driver.returncode:
            error = (hosts.folder / 'driver.err').read_text()[-1500:]
            raise RuntimeError(f'the run did not come to an end: {begun} {error}')
        end = json.loads(text.strip().splitlines()[-1])
        sent = parse_program(PROGRAM).build(20_000.0).n
        return Outcome(
            **{**end, 'faults': tuple(end['faults'])}, sent=sent, dropped=hosts.dropped()
        )


def drive(program: str) -> int:
    """Call ``~/run`` on this host, and print what came of it."""
    from diagnostic_msgs.msg import DiagnosticArray
    from lab_graph import Client
    from piezo_ident.nodes.wire import PREVIEW

    lost, captured = [0], [0]

    def keep(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.strip('/') == 'identifier':
                values = {p.key: p.value for p in status.values}
                lost.append(int(values['lost']))
                captured.append(round(20_000 * float(values['captured'])))

    with Client('driver') as client:
        client.node.create_subscription(DiagnosticArray, '/diagnostics', keep, PREVIEW)
        client.follow('identifier')
        models, reports = client.listen('model'), client.listen('report')
        done, why = client.set('identifier', 'program', Path(program).read_text(), LIMIT)
        if not done:
            raise RuntimeError(why)
        begin = time.monotonic()
        done, why = client.call('identifier/run', LIMIT)
        if not done:
            raise RuntimeError(why)
        ends = ('done', 'failed', 'cancelled')

        def state() -> str:
            return client.status('identifier').get('state', '')

        client.wait(lambda: captured[-1] > 20_000 or state() in ends, LIMIT, 'the program')
        print('running', flush=True)
        client.wait(lambda: state() in ends, LIMIT, 'the end')
        seconds = time.monotonic() - begin
        count = len(lost)
        client.wait(lambda: len(lost) > count, 20.0, 'diagnostics')
        time.sleep(0.5)
        status = client.status('identifier')
        report = json.loads(reports[-1]) if reports else {}
        end = {
            'state': status['state'],
            'message': status['text'],
            'captured': captured[-1],
            'lost': lost[-1],
            'faults': [f['name'] for f in report.get('data_faults', [])],
            'model': models[-1] if models else '',
            'seconds': round(seconds, 2),
        }
        print(json.dumps(end), flush=True)
    return 0


def seen_from(discovery: str) -> dict[str, list[str]]:
    """
    Return which nodes each host sees while one stage runs on each of them.

    `discovery`: for ROS_AUTOMATIC_DISCOVERY_RANGE of who looks; empty for none.
    """
    with Hosts(discovery) as hosts:
        if not discovery:
            del hosts.environment['ROS_AUTOMATIC_DISCOVERY_RANGE']
        command = [sys.executable, str(HERE), '--look']
        looks = [hosts.start(k, [*command, str(k)], f'look{k}') for k in (0, 1)]
        found = [look.communicate(timeout=LIMIT)[0] for look in looks]
        errors = [(hosts.folder / f'look{k}.err').read_text()[-500:] for k in (0, 1)]
    if not all(found):
        raise RuntimeError(f'no host looked: {errors}')
    return {name: json.loads(text) for name, text in zip('ab', found, strict=True)}


def look(host: int) -> int:
    """Start a stage as the demonstration does, and print which stages can be seen."""
    from lab_graph import Client, Nodes

    with tempfile.TemporaryDirectory() as folder, Nodes(Path(folder)) as nodes:
        nodes.start('stage', namespace=f'host{host}')
        with Client(f'look{host}') as client:
            own = f'/host{host}/stage'

            def names() -> list[str]:
                pairs = client.node.get_node_names_and_namespaces()
                return sorted({f'{ns.rstrip("/")}/{n}' for n, ns in pairs if n == 'stage'})

            client.wait(lambda: own in names(), LIMIT, own)
            # the other may be slower by as much; then some time in which it would show
            with contextlib.suppress(Exception):
                client.wait(lambda: len(names()) > 1, 10.0, 'the other')
            print(json.dumps(names()), flush=True)
            time.sleep(3.0)
    return 0


def _result(outcome: Outcome, perfect: str) -> str:
    model = 'no model: refused'
    if outcome.model:
        model = 'another model, with its faults named: ' + ', '.join(outcome.faults)
    if outcome.model and outcome.model == perfect:
        model = 'the model of the perfect network, bit for bit'
    missing = outcome.sent - outcome.captured
    arrived = f'{missing} samples missing and reported' if missing else 'every sample arrived'
    # its cure, behind the semicolon, is for who runs the graph
    reason = '' if outcome.state == 'done' else f' ({outcome.message.partition(";")[0]})'
    return f'{arrived}; {model}{reason}'


def _pooled(results: Counter[str]) -> str:
    """Join the results of all runs; results that differ by numbers alone share their words."""
    texts = [*results.elements()]
    if len({re.sub(NUMBER, '', text) for text in texts}) > 1:
        return '; '.join(f'{n} x {text}' for text, n in results.items())
    columns = zip(*(re.findall(NUMBER, text) for text in texts), strict=True)
    values = iter([' / '.join(c if len({*c}) > 1 else c[:1]) for c in columns])
    return f'{len(texts)} x {re.sub(NUMBER, lambda _: next(values), texts[0])}'


def main() -> int:
    """Run all of it, and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--repeat', type=int, default=3, help='runs of each loss')
    parser.add_argument('--drive', help=argparse.SUPPRESS)
    parser.add_argument('--look', type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.drive:
        return drive(args.drive)
    if args.look is not None:
        return look(args.look)
    reason = why_not()
    if reason:
        print(f'skipped: {reason}')
        return 0
    from rows import crowd, write_rows

    command = f'sudo .venv/bin/python benchmarks/reliability/netns.py --repeat {args.repeat}'
    rows, perfect, honest = [], '', True
    for percent, down in ((0, 0.0), (1, 0.0), (5, 0.0), (0, 10.0)):
        outcomes = [run(percent, down) for _ in range(args.repeat)]
        perfect = perfect or outcomes[0].model
        results: Counter[str] = Counter()
        for o in outcomes:
            honest &= o.is_honest
            text = _result(o, perfect)
            results[text] += 1
            print(f'{percent} % lost, {down:g} s down: {text}; {o.dropped} packets, {o.seconds} s')
        what = f'two hosts, packets dropped both ways: {percent} %'
        what = f'two hosts: the link down for {down:g} s during the program' if down else what
        dropped = sum(o.dropped for o in outcomes)
        how_often = f'{len(outcomes)} runs, {dropped} packets{" dropped" if down else ""}{crowd()}'
        rows.append((what, how_often, _pooled(results)))
    kept, open_ = seen_from(''), seen_from('SUBNET')
    print(kept, open_)
    apart = kept == {'a': ['/host0/stage'], 'b': ['/host1/stage']}
    together = len(open_['a']) == len(open_['b']) == 2
    result = f'{"nothing" if apart else kept} with the default; '
    result += f'{"both" if together else open_} with SUBNET'
    what = 'two hosts: who is seen from the other one, as it is shipped and when asked'
    rows.append((what, '1 run each', result))
    write_rows('netns', rows, command)
    return 0 if honest and apart and together else 1


if __name__ == '__main__':
    sys.exit(main())
