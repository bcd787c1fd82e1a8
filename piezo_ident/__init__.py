# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Identification of piezo-actuated nanopositioning stages.

    import piezo_ident as pi

    record = pi.read('record.csv', displacement_unit='um')
    result = pi.identify(record)
    y_hat = result.model.simulate(v)

Everything public is a name of this module; the names of its submodules may change.  Each name is
imported when it is first used, so that ``import piezo_ident`` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from piezo_ident import effects, report
    from piezo_ident.common.errors import (
        Cancelled,
        ConfigError,
        DataError,
        IdentificationError,
        ModelError,
        PiezoIdentError,
    )
    from piezo_ident.control.inverse import Inverse
    from piezo_ident.control.learning import Learning
    from piezo_ident.control.live_inverse import LiveInverse
    from piezo_ident.diagnosis.results import Diagnosis, DiagnosisSettings
    from piezo_ident.excitation.program import Program
    from piezo_ident.identification.results import Identification
    from piezo_ident.identification.settings import Settings
    from piezo_ident.live.guard import Guard, GuardSettings
    from piezo_ident.model.axes_file import load
    from piezo_ident.model.free_run import FreeRun
    from piezo_ident.model.multi_axis import EachAxis, MultiAxisModel
    from piezo_ident.model.simulated_stage import SimulatedStage
    from piezo_ident.model.stage_model import StageModel
    from piezo_ident.model.two_axis_stage import TwoAxisStage
    from piezo_ident.record.channels import Axes
    from piezo_ident.record.io import read, write
    from piezo_ident.record.record import Record
    from piezo_ident.report.folder import write_report
    from piezo_ident.verbs.export import export_c, export_fmu
    from piezo_ident.verbs.invert import invert, MultiAxisInverse
    from piezo_ident.verbs.learn import diagnose, identify
    from piezo_ident.verbs.predict import free_run

__version__ = '0.1.0'

# public name: where it is defined
_HOMES = {
    'Axes': 'record.channels',
    'Cancelled': 'common.errors',
    'ConfigError': 'common.errors',
    'DataError': 'common.errors',
    'Diagnosis': 'diagnosis.results',
    'DiagnosisSettings': 'diagnosis.results',
    'EachAxis': 'model.multi_axis',
    'FreeRun': 'model.free_run',
    'Guard': 'live.guard',
    'GuardSettings': 'live.guard',
    'Identification': 'identification.results',
    'IdentificationError': 'common.errors',
    'Inverse': 'control.inverse',
    'Learning': 'control.learning',
    'LiveInverse': 'control.live_inverse',
    'ModelError': 'common.errors',
    'MultiAxisInverse': 'verbs.invert',
    'MultiAxisModel': 'model.multi_axis',
    'PiezoIdentError': 'common.errors',
    'Program': 'excitation.program',
    'Record': 'record.record',
    'Settings': 'identification.settings',
    'SimulatedStage': 'model.simulated_stage',
    'StageModel': 'model.stage_model',
    'TwoAxisStage': 'model.two_axis_stage',
    'diagnose': 'verbs.learn',
    'effects': 'effects',
    'export_c': 'verbs.export',
    'export_fmu': 'verbs.export',
    'free_run': 'verbs.predict',
    'identify': 'verbs.learn',
    'invert': 'verbs.invert',
    'load': 'model.axes_file',
    'read': 'record.io',
    'report': 'report',
    'write': 'record.io',
    'write_report': 'report.folder',
}

__all__ = [
    'Axes',
    'Cancelled',
    'ConfigError',
    'DataError',
    'Diagnosis',
    'DiagnosisSettings',
    'EachAxis',
    'FreeRun',
    'Guard',
    'GuardSettings',
    'Identification',
    'IdentificationError',
    'Inverse',
    'Learning',
    'LiveInverse',
    'ModelError',
    'MultiAxisInverse',
    'MultiAxisModel',
    'PiezoIdentError',
    'Program',
    'Record',
    'Settings',
    'SimulatedStage',
    'StageModel',
    'TwoAxisStage',
    '__version__',
    'diagnose',
    'effects',
    'export_c',
    'export_fmu',
    'free_run',
    'identify',
    'invert',
    'load',
    'read',
    'report',
    'write',
    'write_report',
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    home = _HOMES[name]
    module = importlib.import_module(f'{__name__}.{home}')
    value = module if name == home else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
