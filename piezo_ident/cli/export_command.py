# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``export``: a model for other programs."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

from piezo_ident.cli.console import Console, deferred_interrupts
from piezo_ident.cli.outputs import check_output
from piezo_ident.common.errors import ConfigError, naming
from piezo_ident.common.files import write_text
from piezo_ident.export.fmu import export_fmu
from piezo_ident.model.multi_axis import load, MultiAxisModel
from piezo_ident.verbs.export import export_c

SUFFIXES = {'c': '.h', 'fmu': '.fmu'}


def export_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident export``."""
    if args.out is None:
        raise ConfigError('export: no file is named', options='--out stage.h')
    suffixes = [SUFFIXES[args.format]] if args.format else SUFFIXES.values()
    check_output(args.out, suffixes, 'a model', inputs=[args.model], overwrite=args.overwrite)
    is_header = args.out.suffix.lower() == '.h'
    if not is_header and (args.limits or args.slew or args.preview is not None):
        raise ConfigError(
            f'{args.out}: has no feed-forward, which --limits, --slew and --preview are for; '
            'leave them out, or write a header .h'
        )
    name = args.name or re.sub(r'\W', '_', args.out.stem, flags=re.ASCII).lower()
    model = load(args.model)
    title = f'The stage of {args.model.name}'
    header, functions = '', []
    with naming(str(args.model)), deferred_interrupts():
        if is_header:
            header = export_c(
                model,
                name,
                limits=args.limits,
                slew=args.slew or math.inf,
                preview=args.preview,
                title=title,
            )
            write_text(args.out, header)
            known = (f'{name}_step', f'{name}_feedforward_step')
            functions = [function for function in known if f'{function}(' in header]
        elif isinstance(model, MultiAxisModel):
            raise ConfigError(
                f'{args.model}: has several axes; an FMU holds one, write a header .h'
            )
        else:
            export_fmu(model, args.out, name)
    console.say(' '.join([f'wrote {args.out}', *([f'with {", ".join(functions)}'] * is_header)]))
    ahead = re.search(r'_PREVIEW = (\d+)', header)
    preview = int(ahead[1]) if ahead else None
    if preview is not None:
        console.say(
            f'the feed-forward knows the motion {preview} samples ahead, '
            f'{1e3 * preview / model.sample_rate:.4g} ms; --preview N makes it shorter'
        )
    if len(functions) == 1:
        head = header.partition('There is no feed-forward:')[2].partition('*/')[0]
        reason = ' '.join(word for word in head.split() if word != '*')
        console.say(f'  warning: {args.model}: there is no feed-forward: {reason}')
    console.result(
        {
            'model': str(args.model),
            'out': str(args.out),
            'format': 'c' if is_header else 'fmu',
            'name': name,
            'functions': functions,
            'preview': preview,
        }
    )
