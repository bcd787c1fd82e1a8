# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Export a model as an FMU: the C header as a co-simulation of FMI 3.0, in source.

FMI, the Functional Mock-up Interface, is a standard of the Modelica Association.  The program that
compiles the FMU, for example FMPy, supplies the headers of FMI.
"""

from __future__ import annotations

import os
import uuid
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from piezo_ident import __version__
from piezo_ident.common.errors import ModelError
from piezo_ident.common.files import temporary_output
from piezo_ident.export.header import c_number, export_c, plain_text, render
from piezo_ident.export.links import LinkGroup, links_of
from piezo_ident.model.multi_axis import MultiAxisModel
from piezo_ident.model.stage_model import StageModel


def export_fmu(
    model: StageModel | MultiAxisModel, path: str | os.PathLike[str], name: str = 'stage'
) -> None:
    """
    Write a model as an FMU in source: FMI 3.0, co-simulation.

    The inputs are ``voltage`` [V], and ``x_<name>`` for each further channel.  The output is
    ``displacement`` [m].  An existing file is replaced.

    Parameters
    ----------
    model : StageModel
    path : str or path-like
    name : str, optional
        Identifier of the model in C.

    Raises
    ------
    ConfigError
        If the name is not an identifier in C.
    ModelError
        If an effect of the model has no C code, or the model has several axes.
    DataError
        If the file cannot be written.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> pi.export_fmu(pi.SimulatedStage.load('paper').model, 'stage.fmu')
    """
    if isinstance(model, MultiAxisModel):
        raise ModelError('export: the model has several axes, and an FMU holds one; use export_c')
    header = export_c(model, name, feedforward=False)
    links = [link for part in links_of(model) for link in part.links]
    values = {
        'p': name,
        'P': name.upper(),
        'title': name,
        'version': __version__,
        # the token identifies the model, so another model is another FMU
        'token': f'{{{uuid.uuid5(uuid.NAMESPACE_OID, header)}}}',
        'period': repr(1.0 / model.sample_rate),
        'rest': c_number(model.scaling.range[0]).strip('()'),
        'channels': [plain_text(name) for name in LinkGroup(links).channels],
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
