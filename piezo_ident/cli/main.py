# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Arguments in, exit code out.

Exit codes: 0 when done, 2 with one line on standard error for bad input, 130 when interrupted.
Nothing heavy is imported before the arguments are parsed.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
import os
from pathlib import Path
import signal
import sys
from typing import Any, NoReturn

from piezo_ident import __version__
from piezo_ident.common.errors import PiezoIdentError

__all__ = ['main']

DONE, BAD_INPUT, INTERRUPTED = 0, 2, 130


class _Parser(argparse.ArgumentParser):
    """Reports errors in one line, without the usage above it."""

    def error(self, message: str) -> NoReturn:
        line = message.replace('\n', ' ')
        self.exit(BAD_INPUT, f'{self.prog}: error: {line} (see {self.prog} -h)\n')


def _whole(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f'{text!r} is no whole number; give 0 or more')
    return int(text)


def _order(text: str) -> tuple[int, int]:
    parts = text.split(',')
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f'{text!r} is no order; give two numbers, say 10,10')
    return _whole(parts[0]), _whole(parts[1])


def _thresholds(text: str) -> int | None:
    if text == 'auto':
        return None
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f'{text!r}: give a number, or auto')
    return int(text)


def _name(text: str) -> str:
    # an empty shell variable; as a path it would be the working folder
    if not text.strip():
        raise argparse.ArgumentTypeError(f'{text!r} is empty; give a name, or leave it out')
    return text


def _path(text: str) -> Path:
    return Path(_name(text))


def _unit(text: str) -> str:
    # both characters that look like a micro
    return text.replace('\u00b5', 'u').replace('\u03bc', 'u')


def _reading() -> _Parser:
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
    group.add_argument('--namespace', type=_name, help='of the topics of a bag')
    for quantity in ('voltage', 'displacement'):
        text = f'topic of a bag with the {quantity}'
        group.add_argument(f'--{quantity}-topic', type=_name, metavar='TOPIC', help=text)
    return options


def _each() -> _Parser:
    options = _Parser(add_help=False)
    group = options.add_argument_group('many records')
    group.add_argument(
        '--each',
        type=_path,
        metavar='DIR',
        help='take every record on its own; models and a table go there. What is done is kept: '
        'the same command goes on where it was stopped',
    )
    group.add_argument('--jobs', type=_whole, metavar='N', help='processes (default: one a core)')
    group.add_argument(
        '--scheduler', type=_name, metavar='ADDRESS', help='dask scheduler whose workers do it'
    )
    group.add_argument('--reports', action='store_true', help='write a report of every record too')
    return options


def _results() -> _Parser:
    options = _Parser(add_help=False)
    options.add_argument(
        'records', nargs='+', type=_path, metavar='RECORD', help='file, bag, or folder of records'
    )
    options.add_argument('--model', type=_path, metavar='YAML', help='write the model there')
    options.add_argument(
        '--report', type=_path, metavar='DIR', help='write page and pictures there'
    )
    options.add_argument(
        '--validation',
        nargs='+',
        type=_path,
        default=[],
        metavar='RECORD',
        help='further records, which are predicted and take no part in the work',
    )
    return options


def _output() -> _Parser:
    options = _Parser(add_help=False)
    formats = '.csv, .npz, .mat, .mcap, .db3, or a folder for a rosbag2 bag'
    options.add_argument('out', type=_path, metavar='OUT', help=formats)
    options.add_argument('--overwrite', action='store_true', help='replace an existing OUT')
    options.add_argument(
        '--storage', choices=('mcap', 'sqlite3'), help='of a bag folder (default: mcap)'
    )
    return options


def _json() -> _Parser:
    options = _Parser(add_help=False)
    options.add_argument('--json', action='store_true', help='print the result as JSON, only that')
    return options


#: options of `Settings` and `DiagnosisSettings`: type, metavar and help; an option that is absent
#: is left to their defaults
IDENTIFY = {
    '--thresholds': (
        _thresholds,
        'N|auto',
        'number of plays; auto, the default: by held-out error',
    ),
    '--order': (_order, 'NA,NB', 'of G; searched when absent'),
    '--max-order': (_whole, 'N', 'of the search (default: 15)'),
    '--delay': (_whole, 'SAMPLES', 'identified from the data when absent'),
    '--hold-out': (float, 'SECONDS', 'end of an unlabelled record not fitted'),
    '--seed': (_whole, 'N', 'of the swarm (default: 0)'),
}
DIAGNOSE = {
    '--most-effects': (_whole, 'N', 'added (default: 4)'),
    '--most-samples': (_whole, 'N', 'searched, of the beginnings of the records'),
    '--seed': (_whole, 'N', 'of what is drawn (default: 0)'),
}


def _add_settings(parser: _Parser, settings: Mapping[str, tuple[Any, str, str]]) -> None:
    for option, (kind, metavar, text) in settings.items():
        parser.add_argument(
            option, type=kind, default=argparse.SUPPRESS, metavar=metavar, help=text
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

    p = verb('simulate', 'Make a record with the simulated stage', _output(), _json())
    a_file = 'a file, or the name of one'
    p.add_argument('--config', type=_name, default='stage_paper', help=f'stage: {a_file}')
    p.add_argument('--program', type=_name, default='identification', help=f'program: {a_file}')
    p.add_argument('--seed', type=_whole, help="of the sensor noise; the stage's own when absent")
    p.add_argument('--sample-rate', type=float, metavar='HZ', help="the stage's own when absent")

    shared = _results(), _reading(), _each(), _json()
    p = verb('identify', 'Learn a model from records', *shared)
    p.add_argument(
        '--solver',
        choices=('least_squares', 'swarm'),
        default=argparse.SUPPRESS,
        help='of the weights (default: least_squares)',
    )
    p.add_argument(
        '--polish',
        action='store_true',
        default=argparse.SUPPRESS,
        help='let least squares finish what the swarm found',
    )
    _add_settings(p, IDENTIFY)

    p = verb('predict', 'Run a model over a record, or a voltage alone', _reading(), _json())
    p.add_argument('model', type=_path, metavar='MODEL', help='model file')
    p.add_argument(
        'record', type=_path, metavar='RECORD', help='file or bag; a table of t,v will do'
    )
    p.add_argument(
        '--out', type=_path, metavar='OUT', help='.csv or .npz with the columns t, v, y, y_hat'
    )
    p.add_argument('--plot', type=_path, metavar='PNG', help='picture of measured and predicted')

    given = _Parser(add_help=False)
    given.add_argument(
        'model_file',
        type=_path,
        metavar='MODEL',
        help='model file; with --each also a folder with one of the name of every record',
    )
    p = verb('diagnose', 'Find the effect that a model lacks, and add it', given, *shared)
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
    _add_settings(p, DIAGNOSE)

    given = _Parser(add_help=False)
    given.add_argument('record', type=_path, metavar='IN', help='file or bag')
    verb('convert', 'Turn a record into another format', given, _output(), _reading(), _json())

    p = verb('effects', 'List the effects that a model can have', _json())
    p.add_argument('name', nargs='?', type=_name, metavar='NAME', help='say more about this one')
    return parser


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
    try:
        for stream in (sys.stdout, sys.stderr):
            # a terminal without micro signs gets question marks instead of a traceback
            if hasattr(stream, 'reconfigure'):
                stream.reconfigure(errors='replace')
        try:
            args = _build_parser().parse_args(argv)
        except SystemExit as stop:
            return int(stop.code or 0)
        if 'numpy' not in sys.modules:
            # the matrices are narrow: a second thread of BLAS gains nothing, and on a busy
            # machine makes identifications eight times slower
            for name in ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
                os.environ.setdefault(name, '1')
        from piezo_ident.cli import commands

        commands.run(args)
        sys.stdout.flush()
        if argv is None:
            # all is written; an interrupt of the interpreter's end would print a traceback
            signal.signal(signal.SIGINT, signal.SIG_IGN)
    except KeyboardInterrupt:
        if argv is None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        return _stop(INTERRUPTED, 'interrupted; no output is half written')
    except BrokenPipeError:
        # the reader has read enough; the interpreter's own flush must not complain
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except PiezoIdentError as error:
        return _stop(BAD_INPUT, f'error: {error}')
    except OSError as error:
        where = f'{error.filename}: ' if error.filename else ''
        return _stop(BAD_INPUT, f'error: {where}{error.strerror or error}')
    except MemoryError:
        return _stop(BAD_INPUT, 'error: out of memory; give fewer or shorter records')
    return DONE


def _stop(code: int, text: str) -> int:
    line = text.replace('\n', ' ')
    sys.stderr.write(f'piezo_ident: {line}\n')
    return code
