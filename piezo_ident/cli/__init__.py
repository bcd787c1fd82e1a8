# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The command line: ``piezo_ident VERB ...``.

Exit codes: 0 when done, 2 with one line on standard error for bad input, 130 when interrupted.
Nothing heavy is imported before the arguments are understood.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import os
from pathlib import Path
import sys
from typing import NoReturn

from piezo_ident import __version__
from piezo_ident.cli.interrupts import interrupts, MESSAGE, STATUS
from piezo_ident.common.errors import PiezoIdentError

__all__ = ['main']

DONE, BAD_INPUT = 0, 2


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage above it."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f'{self.prog}: error: {_one_line(message)} (see {self.prog} -h)\n')


def _one_line(text: str) -> str:
    return ' '.join(text.split('\n'))


def _whole(text: str) -> int:
    try:
        number = int(text)
    except ValueError:
        number = -1
    if number < 0:
        raise argparse.ArgumentTypeError(f'{text!r} is no whole number; give 0 or more')
    return number


def _order(text: str) -> tuple[int, int]:
    parts = text.split(',')
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f'{text!r} is no order; give two numbers, say 10,10')
    return _whole(parts[0]), _whole(parts[1])


def _thresholds(text: str) -> int | None:
    if text == 'auto':
        return None
    try:
        number = int(text)
    except ValueError:
        number = -1
    if not 2 <= number <= 400:
        raise argparse.ArgumentTypeError(f'{text!r}: give 2 to 400, or auto')
    return number


def _name(text: str) -> str:
    # an empty shell variable; as a path it would be the folder in which we are
    if not text.strip():
        raise argparse.ArgumentTypeError(f'{text!r} is empty; give a name, or leave it out')
    return text


def _path(text: str) -> Path:
    return Path(_name(text))


def _unit(text: str) -> str:
    # both characters that look like a micro
    return text.replace('\u00b5', 'u').replace('\u03bc', 'u')


def _reading() -> _Parser:
    """Return the options of every verb that reads records."""
    options = _Parser(add_help=False)
    group = options.add_argument_group('how to read records')
    group.add_argument(
        '--displacement-unit',
        type=_unit,
        choices=('m', 'mm', 'um', 'nm'),
        default='m',
        help='unit of y in the files',
    )
    group.add_argument(
        '--voltage-limits',
        type=float,
        nargs=2,
        metavar=('LO', 'HI'),
        help='refuse records whose voltage leaves these [V]',
    )
    group.add_argument(
        '--namespace', type=_name, help='take the topics of a bag below this namespace'
    )
    for quantity in ('voltage', 'displacement'):
        group.add_argument(
            f'--{quantity}-topic',
            type=_name,
            metavar='TOPIC',
            help=f'topic of a bag with the {quantity}',
        )
    return options


def _each() -> _Parser:
    """Return the options of the verbs that take many records one by one."""
    options = _Parser(add_help=False)
    group = options.add_argument_group('many records')
    group.add_argument(
        '--each',
        type=_path,
        metavar='DIR',
        help='take every record on its own; a model each, a table and pictures go there. What is '
        'done is kept: the same command goes on where it was stopped',
    )
    group.add_argument('--jobs', type=_whole, metavar='N', help='processes (default: one a core)')
    group.add_argument(
        '--scheduler',
        type=_name,
        metavar='ADDRESS',
        help='have it done by the workers of this dask scheduler, which read the same paths',
    )
    group.add_argument('--reports', action='store_true', help='write a report of every record too')
    return options


def _json() -> _Parser:
    option = _Parser(add_help=False)
    option.add_argument('--json', action='store_true', help='print the result as JSON, only that')
    return option


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        'out',
        type=_path,
        metavar='OUT',
        help='.csv, .npz, .mat, .mcap, .db3, or a folder for a rosbag2 bag',
    )
    parser.add_argument('--overwrite', action='store_true', help='replace an existing OUT')
    parser.add_argument(
        '--storage', choices=('mcap', 'sqlite3'), help='of a bag folder (default: mcap)'
    )


def _add_results(parser: argparse.ArgumentParser, model: str, validation: str) -> None:
    parser.add_argument('--model', type=_path, metavar='YAML', help=f'write the {model} there')
    parser.add_argument(
        '--report', type=_path, metavar='DIR', help='write page and pictures there'
    )
    parser.add_argument(
        '--validation',
        nargs='+',
        type=_path,
        default=[],
        metavar='RECORD',
        help=f'further records: {validation}',
    )


def _build_parser() -> _Parser:
    parser = _Parser(
        prog='piezo_ident',
        description='Identifies piezo nanopositioning stages from voltage and displacement.',
        allow_abbrev=False,
    )
    parser.add_argument('--version', action='version', version=f'piezo_ident {__version__}')
    verbs = parser.add_subparsers(dest='verb', metavar='VERB', required=True)

    def verb(name: str, text: str, *parents: _Parser) -> _Parser:
        return verbs.add_parser(
            name, help=text, description=f'{text}.', parents=[*parents], allow_abbrev=False
        )

    p = verb('simulate', 'Make a record with the simulated stage', _json())
    p.add_argument(
        '--config', type=_name, default='stage_paper', help='stage: a file, or the name of one'
    )
    p.add_argument(
        '--program',
        type=_name,
        default='identification',
        help='programme: a file, or the name of one',
    )
    p.add_argument('--seed', type=_whole, help="of the sensor noise; the stage's own when absent")
    p.add_argument('--sample-rate', type=float, metavar='HZ', help="the stage's own when absent")
    _add_output(p)

    p = verb('identify', 'Learn a model from records', _reading(), _each(), _json())
    p.add_argument(
        'records', nargs='+', type=_path, metavar='RECORD', help='file, bag, or folder of records'
    )
    _add_results(p, 'model', 'predicted, not fitted')
    p.add_argument(
        '--thresholds',
        type=_thresholds,
        metavar='N|auto',
        help='number of plays; auto, the default, chooses it by held-out error',
    )
    p.add_argument('--solver', choices=('least_squares', 'swarm'), default='least_squares')
    p.add_argument(
        '--polish', action='store_true', help='let least squares finish what the swarm found'
    )
    p.add_argument('--order', type=_order, metavar='NA,NB', help='of G; searched when absent')
    p.add_argument(
        '--max-order', type=_whole, default=15, metavar='N', help='of the search (default: 15)'
    )
    p.add_argument(
        '--delay', type=_whole, metavar='SAMPLES', help='found from the data when absent'
    )
    p.add_argument(
        '--hold-out', type=float, metavar='SECONDS', help='end of an unlabelled record not fitted'
    )
    p.add_argument('--seed', type=_whole, default=0, help='of the swarm (default: 0)')

    p = verb('predict', 'Run a model over a record', _reading(), _json())
    p.add_argument('model', type=_path, metavar='MODEL', help='model file')
    p.add_argument('record', type=_path, metavar='RECORD', help='file or bag')
    p.add_argument(
        '--out', type=_path, metavar='OUT', help='.csv or .npz with the columns t, v, y, y_hat'
    )
    p.add_argument('--plot', type=_path, metavar='PNG', help='picture of measured and predicted')

    p = verb(
        'diagnose',
        'Find the effect that a model lacks, and add it',
        _reading(),
        _each(),
        _json(),
    )
    p.add_argument(
        'model_file',
        type=_path,
        metavar='MODEL',
        help='model file; with --each also a folder with one of the name of every record',
    )
    p.add_argument(
        'records',
        nargs='+',
        type=_path,
        metavar='RECORD',
        help='file, bag, or folder of records that the model was not identified from',
    )
    _add_results(p, 'refined model', 'predicted before and after, with no part in the diagnosis')
    for option, text in (
        ('--only', 'try this effect and no other'),
        ('--without', 'do not try this effect'),
    ):
        p.add_argument(
            option,
            type=_name,
            action='append',
            default=[],
            metavar='NAME',
            help=f'{text}; may be given several times',
        )
    p.add_argument(
        '--most-effects', type=_whole, default=4, metavar='N', help='to be added (default: 4)'
    )
    p.add_argument(
        '--most-samples',
        type=_whole,
        default=2_400_000,
        metavar='N',
        help='to be searched, the beginnings of the records (default: 2400000)',
    )
    p.add_argument('--seed', type=_whole, default=0, help='of what is drawn (default: 0)')

    p = verb('convert', 'Turn a record into another format', _reading(), _json())
    p.add_argument('record', type=_path, metavar='IN', help='file or bag')
    _add_output(p)

    p = verb('effects', 'List the effects that a model can have', _json())
    p.add_argument('name', nargs='?', type=_name, metavar='NAME', help='say more about this one')
    return parser


def _one_thread() -> None:
    """
    Keep BLAS on one thread, unless the user said otherwise.

    The matrices here are tall and narrow: a second thread gains nothing on an idle machine, and
    on a busy one they wait for each other, which made identifications eight times slower.
    """
    if 'numpy' not in sys.modules:
        for name in ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
            os.environ.setdefault(name, '1')


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a command.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments; those of the process when absent.

    Returns
    -------
    int
        Exit code.
    """
    with interrupts.handled(is_process=argv is None):
        return _main(argv)


def _main(argv: Sequence[str] | None) -> int:
    try:
        for stream in (sys.stdout, sys.stderr):
            # a terminal without micro signs gets question marks instead of a traceback
            if hasattr(stream, 'reconfigure'):
                stream.reconfigure(errors='replace')
        try:
            args = _build_parser().parse_args(argv)
        except SystemExit as stop:
            return int(stop.code or 0)
        _one_thread()
        with interrupts.quitting():
            from piezo_ident.cli import commands

        code = commands.run(args)
        sys.stdout.flush()
        interrupts.finish()
    except KeyboardInterrupt:
        return _interrupted()
    except BrokenPipeError:
        # whoever read has read enough; the interpreter's own flush must not complain
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except PiezoIdentError as error:
        return _stop(BAD_INPUT, f'error: {error}')
    except OSError as error:
        where = f'{error.filename}: ' if error.filename else ''
        return _stop(BAD_INPUT, f'error: {where}{error.strerror or error}')
    except MemoryError:
        return _stop(BAD_INPUT, 'error: out of memory; give fewer or shorter records')
    except Exception:
        # libraries make errors of their own of it
        if interrupts.met:
            return _interrupted()
        raise
    return code


def _interrupted() -> int:
    interrupts.ignore()
    sys.stderr.write(MESSAGE)
    return STATUS


def _stop(code: int, text: str) -> int:
    if interrupts.met:
        return _interrupted()
    interrupts.ignore()
    sys.stderr.write(f'piezo_ident: {_one_line(text)}\n')
    return code
