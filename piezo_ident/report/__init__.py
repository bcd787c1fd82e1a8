# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Results for people and for programs: a folder with a page, a summary, a picture, JSON.

Examples
--------
>>> import numpy as np
>>> import piezo_ident as pi
>>> v = 5.0 - 5.0 * np.cos(2.0 * np.pi * np.arange(4000) / 1000.0)
>>> record = pi.Record.from_arrays(v, 1e-6 * v, sample_rate=1000.0)
>>> result = pi.identify(record, pi.Settings(thresholds=4))
>>> pi.report.to_json(result)['sample_rate']
1000.0
>>> pi.report.save_plot(result, 'loop.png')
"""

import importlib
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from piezo_ident.report.json_data import to_json as to_json
    from piezo_ident.report.picture import model_text as model_text
    from piezo_ident.report.picture import plot as plot
    from piezo_ident.report.picture import to_html as to_html
    from piezo_ident.report.picture import to_text as to_text

#: public names by their modules: importing all takes half a second, and most callers need one
_HOMES = {
    'advice': ('next_steps', 'Prompt', 'Step'),
    'diagnosis': ('diagnosis_text',),
    'folder': ('check_report_folder', 'write_report'),
    'identification': ('headline', 'identification_text', 'table_one'),
    'json_data': ('json_text', 'steps_to_json', 'to_json'),
    'picture': ('model_text', 'plot', 'save_plot', 'to_html', 'to_text'),
    'refined': ('validated',),
    'table': ('length', 'number', 'plain_text', 'Table'),
}
__all__ = [name for names in _HOMES.values() for name in names]


def __getattr__(name: str) -> Any:
    home = next((home for home, names in _HOMES.items() if name in names), None)
    if home is None:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(importlib.import_module(f'{__name__}.{home}'), name)


def __dir__() -> list[str]:
    return sorted(__all__)
