# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Commands for tests, which work or end in one line, and a table to give them."""

from pathlib import Path

import numpy as np
from piezo_ident.cli import main


def run(capsys, *argv: object) -> tuple[int, str, str]:
    """Run a command, and return its exit code and what it wrote on its two outputs."""
    code = main([str(a) for a in argv])
    said = capsys.readouterr()
    return code, said.out, said.err


def succeed(capsys, *argv: object) -> str:
    """Run a command that works, and return what it prints."""
    code, out, err = run(capsys, *argv)
    assert (code, err) == (0, '')
    return out


def refuse(capsys, folder: Path, argv: list[object], *words: object) -> str:
    """Run a command that cannot work: one line, exit code 2, and nothing changed on disk."""

    def contents() -> dict[Path, bytes | None]:
        return {p: p.read_bytes() if p.is_file() else None for p in folder.rglob('*')}

    before = contents()
    code, out, err = run(capsys, *argv)
    assert (code, out) == (2, ''), out
    assert err.startswith('piezo_ident') and err.endswith('\n') and err.count('\n') == 1, err
    assert 'Traceback' not in err
    for word in words:
        assert str(word) in err
    assert contents() == before
    return err


def table(n: int = 1000) -> dict[str, np.ndarray]:
    """Return the columns of a sound record."""
    v = 5 - 5 * np.cos(np.arange(n) / 50)
    return {'t': np.arange(n) / 1000, 'v': v, 'y': 7.5e-6 * v}


def csv_text(*left_out: str, **columns: object) -> str:
    """Return it as CSV, with columns left out or replaced."""
    c = {k: x for k, x in {**table(), **columns}.items() if k not in left_out}
    rows = [','.join(map(str, row)) for row in zip(*c.values(), strict=True)]
    return '\n'.join([','.join(c), *rows]) + '\n'
