# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Parse the arguments, run a verb, and return an exit code.

Exit codes: 0 when done, 2 with one line on standard error for bad input, 130 when interrupted.
Heavy modules are imported after the arguments are parsed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import importlib
import json
import os
import shlex
import signal
import sys
from types import SimpleNamespace
from typing import Any

import click
from click.shell_completion import get_completion_class
from piezo_ident import __version__
from piezo_ident.cli import options
from piezo_ident.cli.console import Console
from piezo_ident.common.errors import did_you_mean, PiezoIdentError

DONE, BAD_INPUT, INTERRUPTED = 0, 2, 130
#: modules with several verbs, by verb; any other verb has a module of its own name
HOMES = {
    **dict.fromkeys(('convert', 'simulate'), 'record'),
    **dict.fromkeys(('predict', 'invert', 'export'), 'model'),
}
SETTINGS = {'help_option_names': ['-h', '--help']}

RECORD_HELP = 'RECORD is a file, a bag, or a folder of records.'
OUT_HELP = 'OUT is a .csv, .npz, .mat, .mcap or .db3 file, or a folder for a rosbag2 bag.'


def _examples(lines: Sequence[str]) -> str:
    # \b makes click keep the lines
    return '\n'.join(['\b', 'Examples:', *(f'  piezo_ident {line}' for line in lines)])


class Verb(click.Command):
    """Verb with its options by sections; a call returns the parsed arguments."""

    def __init__(
        self,
        name: str,
        text: str,
        arguments: Sequence[click.Argument],
        sections: Mapping[str, Sequence[click.Option]],
        *examples: str,
    ) -> None:
        self.sections = sections
        flags = [x for section in sections.values() for x in section]
        super().__init__(
            name,
            params=[*arguments, *flags, options.JSON],
            callback=lambda **values: SimpleNamespace(verb=name, **values),
            context_settings=SETTINGS,
            help=text,
            epilog=_examples(examples),
        )

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write each section under its title."""
        help_option = self.get_help_option(ctx)
        last = [options.JSON, *([help_option] if help_option else [])]
        for title, section in {**self.sections, 'General': last}.items():
            with formatter.section(title):
                formatter.write_dl([x.get_help_record(ctx) or ('', '') for x in section])

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Let --validation take all words up to the next option, as a pattern gives them."""
        words: list[str] = []
        taking = False
        for before, word in zip(['', *args], args, strict=False):
            if word.startswith('-'):
                taking = word == '--validation'
            elif taking and before != '--validation':
                words.append('--validation')
            words.append(word)
        return super().parse_args(ctx, words)


class Verbs(click.Group):
    """Group of all verbs; its error suggests a verb for a misspelt one."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """List the verbs in the order of use."""
        return list(self.commands)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """Return the verb and its arguments."""
        if not ctx.resilient_parsing and args[0] not in self.commands:
            guess = did_you_mean(args[0], self.commands) or f'give {", ".join(self.commands)}'
            ctx.fail(f'no such verb: {args[0]}; {guess}')
        return super().resolve_command(ctx, args)


def _completion(ctx: click.Context, _: Any, shell: str | None) -> None:
    kind = get_completion_class(shell) if shell else None
    if kind is not None:
        click.echo(kind(cli, {}, 'piezo_ident', '_PIEZO_IDENT_COMPLETE').source())
        ctx.exit()


cli = Verbs(
    subcommand_metavar='VERB ...',
    context_settings=SETTINGS,
    help='Identifies piezo nanopositioning stages from voltage and displacement.',
    epilog=_examples(
        [
            'simulate record.npz',
            'identify record.npz --model model.yaml --report report/',
            'predict --help',
        ]
    ),
    params=[
        click.Option(
            ['--completion'],
            type=click.Choice(['bash', 'zsh', 'fish']),
            help='Print the completion of a shell: eval "$(piezo_ident --completion bash)"',
            is_eager=True,
            expose_value=False,
            callback=_completion,
        )
    ],
    commands=[
        Verb(
            'simulate',
            f'Make a record with the simulated stage.\n\n{OUT_HELP} A .yaml file holds the '
            'program itself, scaled to the limits, for the excitation node.',
            [options.OUT],
            {'Stage and program': options.SIMULATE, 'Output': options.OUTPUT},
            'simulate record.npz',
            'simulate --config paper --program validation --seed 2 validation.csv',
            'simulate --sample-rate 2000 --limits 0 100 --voltage-only excitation.csv',
            'simulate --program holds --sample-rate 2000 --limits 0 100 my_holds.yaml',
        ),
        Verb(
            'identify',
            f'Learn a model from records.\n\n{RECORD_HELP}',
            [options.RECORDS],
            {
                'Outputs': options.RESULTS,
                'How to read records': options.READING,
                'How to identify': options.IDENTIFY,
                'Many records': options.EACH,
            },
            'identify record.csv --displacement-unit um --model model.yaml --report report/',
            'identify record.npz --validation other.npz --model model.yaml',
            'identify records/ --each line/',
        ),
        Verb(
            'predict',
            'Run a model over a record, or over a voltage alone.\n\n'
            'RECORD is a file or a bag; a table of t,v will do.',
            [options.MODEL, options.RECORD],
            {'Outputs': options.PREDICT, 'How to read records': options.READING},
            'predict model.yaml other.csv --plot other.png',
            'predict model.yaml scan.csv --out predicted.csv',
        ),
        Verb(
            'invert',
            'Find the voltage under which a stage moves as wanted.\n\n'
            'REFERENCE is a table of t,y: the time and the wanted displacement, at the rate of '
            'the model.',
            [options.MODEL, options.REFERENCE],
            {
                'Outputs': options.INVERT,
                'The voltage': options.DRIVE,
                'How to read the motion': options.MOTION,
            },
            'invert model.yaml scan.csv --out drive.csv --plot drive.png',
            'invert model.yaml scan.csv --displacement-unit um --limits 0 9 --clip',
        ),
        Verb(
            'export',
            'Write a model for other programs: a C header with prediction and feed-forward, or an '
            'FMU in source (FMI 3.0, co-simulation).',
            [options.MODEL],
            {'Output': options.EXPORT, 'The feed-forward of a header': options.FEEDFORWARD},
            'export model.yaml --format c --out stage.h',
            'export model.yaml --out stage.h --limits 0 9 --slew 5e3 --preview 40',
            'export model.yaml --format fmu --out stage.fmu',
        ),
        Verb(
            'diagnose',
            'Find the effect that a model lacks, and add it.\n\nMODEL is a model file; with '
            f'--each also a folder of model files with the names of the records. {RECORD_HELP}',
            [options.MODEL_FILE, options.RECORDS],
            {
                'Outputs': options.RESULTS,
                'How to read records': options.READING,
                'How to diagnose': options.DIAGNOSE,
                'Many records': options.EACH,
            },
            'diagnose model.yaml other.csv --model refined.yaml --report diagnosis/',
            'diagnose model.yaml other.csv --only creep --only thermal_drift',
            'diagnose line/ others/ --each checked/',
        ),
        Verb(
            'convert',
            f'Turn a record into another format.\n\nIN is a file or a bag. {OUT_HELP}',
            [options.IN, options.OUT],
            {'Output': options.OUTPUT, 'How to read records': options.READING},
            'convert --displacement-unit um record.csv record.npz',
            'convert scope.csv record.csv --columns "t=Zeit [ms],v=Kanal A,y=Kanal B"',
            'convert samples.txt record.csv --rate 20e3 --columns v=1,y=2 --displacement-unit um',
            'convert recorded_bag/ record.csv',
        ),
        click.Command(
            'node',
            params=[options.NODE, options.NODE_ARGUMENTS],
            callback=lambda **values: SimpleNamespace(verb='node', json=False, **values),
            # the words after the name are for ROS
            context_settings={
                **SETTINGS,
                'ignore_unknown_options': True,
                'allow_interspersed_args': False,
            },
            help='Start a node without the tools of ROS.\n\nNAME is a node; without NAME all '
            'nodes are listed. ARGUMENTS are passed to ROS.',
            epilog=_examples(['node model --help', 'node model --ros-args -r __ns:=/stage_a']),
        ),
        Verb(
            'effects',
            'List the effects that a model can have, or say more about one.',
            [options.EFFECT],
            {},
            'effects',
            'effects creep',
        ),
    ],
)
click.version_option(__version__, message='piezo_ident %(version)s')(cli)


def _told(error: click.UsageError) -> str:
    text = error.format_message()
    if isinstance(error, click.NoSuchOption):
        guess = did_you_mean(error.option_name, error.possibilities or ())
        text = f'no such option: {error.option_name}{guess and "; "}{guess}'
    return f'{text} (see {error.ctx.command_path if error.ctx else "piezo_ident"} --help)'


def _discard_output() -> None:
    # the reader has closed the pipe, or the disk is full; the final flush must not fail again
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _stop(words: Sequence[str], code: int, text: str, kind: str) -> int:
    line = ' '.join(text.split('\n'))
    sys.stderr.write(f'piezo_ident: {"error: " if code == BAD_INPUT else ""}{line}\n')
    try:
        if '--json' in words:
            data = {'kind': kind, 'message': line, 'exit_code': code}
            sys.stdout.write(f'{json.dumps({"error": data}, indent=2, ensure_ascii=False)}\n')
        sys.stdout.flush()
    except OSError:
        _discard_output()
    return code


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command, by default with the arguments of the process; return the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        for name in ('stdout', 'stderr'):
            # None where the caller has closed it: nobody reads
            stream = getattr(sys, name) or open(os.devnull, 'w', encoding='utf-8')
            setattr(sys, name, stream)
            # a terminal without micro signs gets question marks instead of a traceback
            if hasattr(stream, 'reconfigure'):
                stream.reconfigure(errors='replace')
        args = cli.main(words or ['--help'], 'piezo_ident', standalone_mode=False)
        if not isinstance(args, SimpleNamespace):  # help or version
            return int(args or DONE)
        if 'numpy' not in sys.modules:
            # the matrices are narrow: a second thread of BLAS saves no time, and slows an
            # identification down eight times on a busy machine
            for name in ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
                os.environ.setdefault(name, '1')
        # imports the modules of this verb alone
        home = HOMES.get(args.verb, args.verb)
        module = importlib.import_module(f'piezo_ident.cli.{home}_command')
        console = Console(args.json)
        with console.notices():
            getattr(module, f'{args.verb}_command')(args, console)
        sys.stdout.flush()
        if argv is None:
            # all is written; an interrupt while the interpreter ends would print a traceback
            signal.signal(signal.SIGINT, signal.SIG_IGN)
    except (KeyboardInterrupt, click.Abort):
        if argv is None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        return _stop(words, INTERRUPTED, 'interrupted; no output is half written', 'Interrupted')
    except BrokenPipeError:
        _discard_output()
    except click.UsageError as error:
        return _stop(words, BAD_INPUT, _told(error), 'UsageError')
    except PiezoIdentError as error:
        text = str(error)
        if error.options:
            text = text.replace(f', as in {error.options}', '')
            text += f'; for example: piezo_ident {shlex.join(words)} {error.options}'
        return _stop(words, BAD_INPUT, text, type(error).__name__)
    except OSError as error:
        where = f'{error.filename}: ' if error.filename else ''
        return _stop(words, BAD_INPUT, f'{where}{error.strerror or error}', 'OSError')
    except MemoryError:
        text = 'out of memory; give fewer or shorter records'
        return _stop(words, BAD_INPUT, text, 'MemoryError')
    return DONE
