# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Read and write model files: YAML documents, read by the safe loader and written atomically."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
import difflib
import math
import os
import reprlib
from typing import Any

import numpy as np
from piezo_ident import __version__
from piezo_ident.common.errors import ModelError
from piezo_ident.common.files import load_yaml
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
import yaml

SCHEMA_VERSION = 1
#: most effects of a model, and largest order of G (finding its roots costs the third power of it)
EFFECTS, ORDER = 50, 200

_REQUIRED = ('sample_rate', 'input', 'output', 'delay', 'hysteresis', 'dynamics')
_OPTIONAL = ('schema_version', 'package_version', 'effects', 'identification')
#: size of numbers, and of their inverse, up to which no displacement overflows: u is below its
#: square, u^4 below its eighth power, and three more factors leave that far below 1e308
LARGE = 1e20
#: arrays of a hysteresis beyond plays and a cubic
_WIDE = ('curves', 'bias', 'relaxations')
_INSIDE: Mapping[str, tuple[str, ...]] = {
    'input': ('v0', 'V', 'range'),
    'output': ('y0', 'Y'),
    'delay': ('samples', 'fraction'),
    'hysteresis': ('thresholds', 'weights', 'p1', 'p2', 'p0', 'span', *_WIDE),
    'dynamics': ('a', 'b'),
}
_EFFECT = ('name', 'slot', 'parameters')


class _Dumper(yaml.SafeDumper):
    """YAML writer that puts a list of numbers on one line, and everything else in blocks."""


def _represent_list(dumper: yaml.SafeDumper, data: list[Any]) -> yaml.Node:
    flow = all(isinstance(x, (int, float, str)) for x in data)
    return dumper.represent_sequence('tag:yaml.org,2002:seq', data, flow_style=flow)


_Dumper.add_representer(list, _represent_list)


def plain(value: Any) -> Any:
    """Convert nested mappings, sequences and numpy values to plain Python data."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return value


def finite(value: Any) -> Any:
    """Replace numbers that JSON cannot hold by None in plain data."""
    if isinstance(value, dict):
        return {key: finite(x) for key, x in value.items()}
    if isinstance(value, list):
        return [finite(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _part(data: Mapping[str, Any], key: str, name: str) -> Mapping[str, Any]:
    value = data.get(key)
    if not isinstance(value, Mapping):
        raise ModelError(f'{name}: {key} must be a mapping, see config/stage_paper.yaml')
    return value


def number(data: Mapping[str, Any], key: str, name: str, default: float | None = None) -> float:
    """Read a number of a mapping, or raise ModelError; ``2e-5`` counts, though YAML reads text."""
    value = data.get(key, default)
    if isinstance(value, bool) or value is None:
        raise ModelError(f'{name}: {key} is missing or not a number: {value}')
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise ModelError(f'{name}: {key} is not a number: {reprlib.repr(value)}') from None


def numbers(data: Mapping[str, Any], key: str, name: str) -> np.ndarray[Any, Any]:
    """Read a list of numbers of a mapping, or raise ModelError."""
    value = data.get(key)
    if not isinstance(value, list) or any(isinstance(x, bool) for x in value):
        raise ModelError(f'{name}: {key} must be a list of numbers')
    try:
        return np.array([float(x) for x in value], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ModelError(f'{name}: {key} must be a list of numbers') from None


def _unknown(data: Mapping[str, Any], known: Collection[str]) -> list[str]:
    return sorted(set(map(str, data)) - set(known))


def _similar(key: str, known: Iterable[str]) -> str | None:
    names = {name.lower(): name for name in known}
    close = difflib.get_close_matches(key.lower(), names, n=1)
    return names[close[0]] if close else None


def check_keys(data: Mapping[str, Any], known: Collection[str], where: str, name: str) -> None:
    """Refuse unknown keys with a ModelError that suggests similar known keys."""
    unknown = _unknown(data, known)
    if not unknown:
        return
    similar = list(dict.fromkeys(filter(None, (_similar(key, known) for key in unknown))))
    cure = f'did you mean {", ".join(similar)}?' if similar else f'known are {", ".join(known)}'
    listed = ', '.join(key[:40] for key in unknown[:8])
    raise ModelError(f'{name}: unknown keys {listed}{where}; {cure}')


def check_version(data: Mapping[str, Any], name: str, latest: int = SCHEMA_VERSION) -> None:
    """Refuse a file of a later schema than the latest one with a ModelError."""
    version = data.get('schema_version', latest)
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise ModelError(
            f'{name}: schema_version must be a whole number, got {reprlib.repr(version)}'
        )
    if version > latest:
        raise ModelError(
            f'{name}: written with model schema {reprlib.repr(version)}, this package reads up to '
            f'{latest}; update piezo_ident'
        )


def _check_layout(data: Mapping[str, Any], name: str) -> None:
    """Refuse another schema, missing parts and unknown keys."""
    if 'several_axes' in data:
        raise ModelError(f'{name}: a model of several axes by an earlier version; identify again')
    if 'axes' in data:
        raise ModelError(f'{name}: a model of several axes; here a model of one axis is needed')
    check_version(data, name)
    missing = [key for key in _REQUIRED if key not in data]
    known = (*_REQUIRED, *_OPTIONAL)
    # a missing part may be there under a misspelt name; otherwise the file is of another kind
    if missing and not any(_similar(key, missing) for key in _unknown(data, known)):
        raise ModelError(f'{name}: missing {", ".join(missing)}; is this a model file?')
    check_keys(data, known, '', name)
    for part, keys in _INSIDE.items():
        check_keys(_part(data, part, name), keys, f' in {part}', name)


def _effects(data: Mapping[str, Any], name: str) -> tuple[EffectSetting, ...]:
    """Read the effects of a model."""
    effects = data.get('effects') or []
    if not isinstance(effects, list) or not all(isinstance(e, Mapping) for e in effects):
        raise ModelError(f'{name}: effects must be a list of mappings')
    if len(effects) > EFFECTS:
        raise ModelError(f'{name}: {len(effects)} effects; give at most {EFFECTS}')
    for effect in effects:
        check_keys(effect, _EFFECT, ' in effects', name)
    return tuple(
        EffectSetting(
            str(effect.get('name')),
            {str(key): value for key, value in _part(effect, 'parameters', name).items()},
        )
        for effect in effects
    )


def model_from_dict(data: Mapping[str, Any], name: str = 'model') -> StageModel:
    """
    Build a model from the contents of a model file; messages contain the `name` of the file.

    Raises ModelError if the schema is later than this package knows, or a part is missing or
    wrong.
    """
    _check_layout(data, name)
    source, target = _part(data, 'input', name), _part(data, 'output', name)
    delay, h = _part(data, 'delay', name), _part(data, 'hysteresis', name)
    g = _part(data, 'dynamics', name)
    limits = numbers(source, 'range', name)
    if limits.size != 2:
        raise ModelError(f'{name}: input.range must be [lowest, highest] voltage')
    identification = data.get('identification') or {}
    if not isinstance(identification, Mapping):
        raise ModelError(f'{name}: identification must be a mapping')
    samples = number(delay, 'samples', name)
    if not samples.is_integer():
        raise ModelError(f'{name}: delay.samples must be a whole number, got {samples}')
    a, b = numbers(g, 'a', name), numbers(g, 'b', name)
    if max(a.size, b.size) > ORDER:
        raise ModelError(f'{name}: dynamics of order {max(a.size, b.size)}; at most {ORDER}')
    try:
        model = StageModel(
            sample_rate=number(data, 'sample_rate', name),
            scaling=Scaling(
                v0=number(source, 'v0', name),
                V=number(source, 'V', name),
                y0=number(target, 'y0', name),
                Y=number(target, 'Y', name),
                range=(float(limits[0]), float(limits[1])),
            ),
            hysteresis=Hysteresis(
                thresholds=numbers(h, 'thresholds', name),
                weights=numbers(h, 'weights', name),
                p1=number(h, 'p1', name),
                p2=number(h, 'p2', name),
                **_wide(h, name),
            ),
            dynamics=Dynamics(a=a, b=b),
            delay=Delay(int(samples), number(delay, 'fraction', name, 0.0)),
            effects=_effects(data, name),
            identification=dict(identification),
        )
    except ModelError as error:
        raise (error if str(error).startswith(name) else ModelError(f'{name}: {error}')) from None
    if not _is_finite(model):
        raise ModelError(
            f'{name}: the displacement over the range {limits[0]:g} .. {limits[1]:g} V is not '
            'finite; correct the largest and smallest numbers'
        )
    return model


def _is_finite(model: StageModel) -> bool:
    """Tell whether the displacements over the range are finite."""
    parts = vars(model.scaling).values(), vars(model.hysteresis).values(), [model.dynamics.gain]
    sizes = np.abs([n for part in parts for x in part if x is not None for n in np.ravel(x)])
    # ordinary numbers do not overflow, and H would load or compile its kernels
    if np.all((sizes == 0.0) | ((sizes > 1.0 / LARGE) & (sizes < LARGE))):
        return True
    with np.errstate(all='ignore'):
        try:
            w = model.hysteresis(model.scaling.u(np.linspace(*model.scaling.range, 3)))
        except OverflowError:
            return False
        return bool(np.isfinite(model.scaling.y(model.dynamics.gain * w)).all())


def _wide(h: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Read the terms of a hysteresis beyond plays and a cubic."""
    wide: dict[str, Any] = {'p0': number(h, 'p0', name, 0.0)}
    for key in ('curves', 'relaxations'):
        if h.get(key, []) == []:
            continue  # a sum of no plays has no curves
        rows, where = h[key] if isinstance(h[key], list) else [None], f'hysteresis.{key}'
        parsed = [numbers({where: row}, where, name) for row in rows]
        if len({row.size for row in parsed}) > 1:
            raise ModelError(f'{name}: {where} must have rows of one length')
        wide[key] = np.array(parsed).reshape(len(parsed), -1)
    if 'bias' in h:
        wide['bias'] = numbers(h, 'bias', name)
    if 'span' in h:
        span = numbers(h, 'span', name)
        if span.size != 2:
            raise ModelError(f'{name}: hysteresis.span must be [lowest, highest] voltage')
        wide['span'] = (float(span[0]), float(span[1]))
    return wide


def model_to_dict(model: StageModel) -> dict[str, Any]:
    """Convert a model to plain data, ready for YAML or JSON."""
    s, h = model.scaling, model.hysteresis
    data = {
        'schema_version': SCHEMA_VERSION,
        'package_version': __version__,
        'sample_rate': model.sample_rate,
        'input': {'v0': s.v0, 'V': s.V, 'range': list(s.range)},
        'output': {'y0': s.y0, 'Y': s.Y},
        'delay': {'samples': model.delay.samples, 'fraction': model.delay.fraction},
        'hysteresis': {
            'thresholds': h.thresholds,
            'weights': h.weights,
            'p1': h.p1,
            'p2': h.p2,
            **({} if h.is_plain else {'p0': h.p0}),
            **{k: x for k in _WIDE if (x := getattr(h, k)) is not None},
            **({'span': list(h.span)} if any(getattr(h, k) is not None for k in _WIDE) else {}),
        },
        'dynamics': {'a': model.dynamics.a, 'b': model.dynamics.b},
        'effects': [
            {'name': e.name, 'slot': e.slot, 'parameters': e.parameters} for e in model.effects
        ],
        'identification': model.identification,
    }
    result: dict[str, Any] = plain(data)
    return result


def model_to_yaml(model: StageModel) -> str:
    """Write the text of a model file."""
    return yaml_text(model_to_dict(model))


def yaml_text(data: Mapping[str, Any]) -> str:
    """Write plain data as YAML, with lists of numbers on one line."""
    text: str = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=99)
    return text


def load(path: str | os.PathLike[str]) -> StageModel:
    """
    Read a model file of one axis.

    Raises
    ------
    ConfigError
        If the file cannot be read or is not YAML.
    ModelError
        If the file is not a model of one axis, or has a later schema.
    """
    return model_from_dict(load_yaml(path), str(path))
