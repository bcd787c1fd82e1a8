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


@pytest.mark.parametrize(
    'work', ['ENDING.on_wanted = hang; time.sleep(100)', 'ENDING.is_wanted.wait(); hang()']
)
def test_it_ends_when_a_call_keeps_the_interpreter_and_tells_where(work):
    # a function of `PyDLL` keeps the lock of the interpreter
    hang = 'def hang():\n    ctypes.PyDLL(None).sleep(100)\n'
    code, said = ended(f'{hang}ENDING.patience = 0.3', work)
    assert code == 1 and 'in hang' in said
