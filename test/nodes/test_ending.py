# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The end of a process on a signal: at once, after its patience, or when it hangs."""

import signal
import subprocess
import sys

from processes import LIMIT
import pytest

PROCESS = """
import ctypes, time
from piezo_ident.nodes.ending import ENDING
ENDING.listen()
{preparation}
print('up', flush=True)
{work}
"""


def ended(preparation: str, work: str, number: int = signal.SIGINT) -> tuple[int, str]:
    """Return the exit code of a process after a signal, and its errors."""
    code = PROCESS.format(preparation=preparation, work=work)
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, '-c', code], stdout=pipe, stderr=pipe) as process:
        try:
            assert process.stdout.readline() == b'up\n'
            process.send_signal(number)
            return process.wait(LIMIT), process.stderr.read().decode()
        finally:
            process.kill()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_busy_process_ends(number):
    assert ended('', 'while True: pass', number) == (0, '')


def test_it_tells_what_is_cut_off_when_its_patience_is_over():
    code, said = ended(
        "ENDING.patience, ENDING.unfinished = 0.2, 'the file was closed'", 'time.sleep(100)'
    )
    assert code == 1 and 'ended before the file was closed' in said


def test_it_knows_how_much_time_is_left():
    # before a signal all of it; 0.3 s after one, what is left of 5 s
    count = 'print(ENDING.left, file=sys.stderr)'
    code, said = ended(
        f'import sys; ENDING.patience = 5.0; {count}',
        f'ENDING.is_wanted.wait(); time.sleep(0.3); {count}; ENDING.leave(0)',
    )
    before, after = map(float, said.split())
    assert code == 0 and before == 5.0 and 0.0 < after < 4.7001


@pytest.mark.parametrize('code', [0, 1])
def test_it_ends_after_the_last_moment_though_a_call_keeps_the_interpreter(code):
    # a function of `PyDLL` keeps the lock of the interpreter; a signal ends a sleep
    work = f'ENDING.leave_within_last({code})\nwhile True: ctypes.PyDLL(None).sleep(100)'
    assert ended('ENDING.patience = 5.0', work) == (code, '')
