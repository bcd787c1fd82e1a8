# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Export a model as an FMU: the C header as a co-simulation of FMI 3.0, in source.

FMI, the Functional Mock-up Interface, is a standard of the Modelica Association.  The program that
compiles the FMU, for example FMPy, supplies the headers of FMI.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import os
import uuid
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from piezo_ident import __version__
from piezo_ident.common.files import temporary_output
from piezo_ident.export.header import c_number, plain_text, render


def write_fmu(
    path: str | os.PathLike[str],
    name: str,
    header: str,
    sample_rate: float,
    rests: Mapping[str, float],
    clocks: Sequence[str],
    channels: Mapping[str, str],
) -> None:
    """
    Write a C header as an FMU; see `piezo_ident.export_fmu`.

    Parameters
    ----------
    path : str or path-like
    name : str
        Beginning of all names in the header.
    header : str
    sample_rate : float
        [Hz]
    rests : mapping of str to float
        Initial voltage of each axis [V], by the part of its name after ``voltage``.
    clocks : sequence of str
        Members of the state that count samples; ``k`` alone in the state of one axis.
    channels : mapping of str to str
        Names of the further channels by the members of the state that hold them.
    """
    inputs = [*dict.fromkeys(channels.values())]
    values = {
        'p': name,
        'P': name.upper(),
        'title': name,
        'version': __version__,
        # the token identifies the model, so another model is another FMU
        'token': f'{{{uuid.uuid5(uuid.NAMESPACE_OID, header)}}}',
        'period': repr(1.0 / sample_rate),
        'axes': {axis: c_number(v).strip('()') for axis, v in rests.items()},
        'several': [*clocks] != ['k'],
        'clocks': clocks,
        'channels': [plain_text(channel) for channel in inputs],
        'members': {x: len(rests) + inputs.index(c) for x, c in channels.items()},
    }
    files = {
        'modelDescription.xml': render('modelDescription.xml', **values),
        'sources/buildDescription.xml': render('buildDescription.xml', **values),
        'sources/fmi3.c': render('fmi3.c', **values),
        f'sources/{name}.h': header,
    }
    with (
        temporary_output(os.fspath(path), overwrite=True) as target,
        ZipFile(target, 'w') as archive,
    ):
        for file, text in files.items():
            # no time stamp, so that the same model gives the same file
            archive.writestr(ZipInfo(file), text, ZIP_DEFLATED)
