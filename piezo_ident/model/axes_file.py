# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Read and write the model file of one axis or of several."""

from __future__ import annotations

from collections.abc import Mapping
import os
from typing import Any

from piezo_ident.common.errors import ModelError
from piezo_ident.common.files import load_yaml
from piezo_ident.model.files import (
    check_version,
    model_from_dict,
    model_to_dict,
    model_to_yaml,
    plain,
    yaml_text,
)
from piezo_ident.model.modes.shared_modes import modes_from_dict, modes_to_dict
from piezo_ident.model.multi_axis import MultiAxisModel
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.channels import role_of

#: versions of a model file with several axes, with shared modes, and with modes that creep
SCHEMA_VERSION, MODES_VERSION, CREEP_VERSION = 2, 3, 4


def text_of(model: StageModel | MultiAxisModel) -> str:
    """Write a model as the text of its file."""
    if isinstance(model, StageModel):
        return model_to_yaml(model)
    of_axes = {axis: model_to_dict(x) for axis, x in model.axes.items()}
    if model.modes is None:
        return yaml_text({'schema_version': SCHEMA_VERSION, 'axes': of_axes})
    modes = modes_to_dict(model.modes)
    version = CREEP_VERSION if 'creep' in modes else MODES_VERSION
    return yaml_text({'schema_version': version, 'axes': of_axes, 'modes': plain(modes)})


def from_dict(data: Mapping[str, Any], name: str) -> StageModel | MultiAxisModel:
    """Build a model of one axis or of several from the contents of its file."""
    return (multi_axis_from_dict if 'axes' in data else model_from_dict)(data, name)


def multi_axis_from_dict(data: Mapping[str, Any], name: str) -> MultiAxisModel:
    """Build a model of several axes from the contents of its file; raise ModelError on a fault."""
    check_version(data, name, CREEP_VERSION)
    axes = data['axes']
    if not (
        isinstance(axes, Mapping) and axes and all(isinstance(x, Mapping) for x in axes.values())
    ):
        raise ModelError(f'{name}: axes must name a model for each axis; see docs/two_axes.md')
    if wrong := [str(k) for k in axes if k != 'y' and role_of(str(k)) != 'y']:
        raise ModelError(f'{name}: axes {", ".join(wrong)}: an axis is y, or y_ and its name')
    try:
        models = {str(k): model_from_dict(x, f'{name}: axes.{k}') for k, x in axes.items()}
        modes = data.get('modes')
        return MultiAxisModel(models, modes and modes_from_dict(modes, len(models), name))
    except ModelError as error:
        raise (error if str(error).startswith(name) else ModelError(f'{name}: {error}')) from None


def load(path: str | os.PathLike[str]) -> StageModel | MultiAxisModel:
    """
    Read a model file, of one axis or of several.

    Raises
    ------
    ConfigError
        When the file cannot be read or is not YAML.
    ModelError
        When the file does not hold a model, or has a later schema.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> pi.SimulatedStage.load('paper').model.save('model.yaml')
    >>> model = pi.load('model.yaml')
    >>> model.sample_rate, model.hysteresis.thresholds.size
    (20000.0, 9)
    """
    return from_dict(load_yaml(path), str(path))
