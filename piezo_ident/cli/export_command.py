# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``export``: a model for other programs."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

from piezo_ident.cli.console import Console, deferred_interrupts
from piezo_ident.cli.outputs import check_distinct, check_file, check_suffix
from piezo_ident.cli.records import naming
from piezo_ident.common.errors import ConfigError
from piezo_ident.common.files import write_text
from piezo_ident.export.header import export_c
from piezo_ident.model.files import load

__all__ = ['export_command']


def export_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident export``."""
    if args.out is None:
        raise ConfigError('export: no file is named', options='--out stage.h')
    check_suffix(args.out, ('.h',), 'a header')
    check_distinct(args.out, [args.model])
    check_file(args.out, overwrite=args.overwrite)
    name = args.name or re.sub(r'\W', '_', args.out.stem, flags=re.ASCII).lower()
    model = load(args.model)
    with naming(str(args.model)):
        header = export_c(
            model,
            name,
            limits=args.limits,
            slew=args.slew or math.inf,
            title=f'The stage of {args.model.name}',
        )
    with deferred_interrupts():
        write_text(args.out, header)
    has_inverse = f'{name}_feedforward_step' in header
    console.say(f'wrote {args.out}: {name}_step' + has_inverse * f', {name}_feedforward_step')
    if not has_inverse:
        console.say('  warning: there is no feed-forward; the head of the file says why')
    console.result(
        {
            'model': str(args.model),
            'out': str(args.out),
            'format': args.format,
            'name': name,
            'feedforward': has_inverse,
        }
    )
