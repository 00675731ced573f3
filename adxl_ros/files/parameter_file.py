# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The parameter file: what ROS nodes load, what `fit` writes, with one check for all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
import os
from pathlib import Path
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import atomic_path
from adxl_ros.model.coefficients import names_of, neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, Role
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.validity import Envelope
import numpy as np
import yaml

FORMAT = 1
"""Version of the parameter file's format; another one is refused."""

UNITS = 'V, V/g, 1/g, rad'
"""Units of the coefficients, written into every file and checked."""

FIGURES = {f.metadata['key']: f for f in fields(Sensor) if f.metadata}

ENVELOPE = {
    'temperature_c': 'lowest and highest temperature of the poses, degC',
    'zero_g_per_k': 'drift of the zero-g beyond them, g/K',
    'scale_per_k': 'drift of the scale factor beyond them, 1/K',
    'leverage': 'largest leverage of the poses, (m/s^2)^2',
    'misfit_mps2': 'what poses held out showed beyond noise and stage, m/s^2',
    'force_low_mps2': 'least specific force of the poses by component, m/s^2',
    'force_high_mps2': 'greatest specific force of the poses by component, m/s^2',
}
"""Keys of `envelope.*`, those of `model.validity.Envelope`; each may be missing."""
ENVELOPE_LISTS = {'temperature_c': 2, 'force_low_mps2': 3, 'force_high_mps2': 3}

DATASHEET = {
    'name': 'what the figures are of',
    'figures': 'effect.parameter that the datasheet bounds',
    'typical': 'typical departures, 0.0 where not stated',
    'maximum': 'greatest departures, 0.0 where not stated',
}
"""Keys of `datasheet.*`; all of them or none."""


def load(path: str | os.PathLike) -> Sensor:
    """
    Read and check a parameter file.

    Raises
    ------
    UserError
        Not readable, not YAML, a key missing or unknown, a value of the wrong type, unit, length
        or range, a covariance that is not positive: naming file, line and column.

    """
    flat, marks = _read(Path(path))

    def fail(key: str, why: str) -> UserError:
        # What is missing has no place of its own: name that of what it belongs to.
        place = key
        while place not in marks:
            place = place.rpartition('.')[0]
        return UserError(f'{_where(path, marks[place])}: {key}: {why}')

    return from_flat(flat, fail)


def from_flat(flat: dict[str, Any], fail: Any) -> Sensor:
    """
    Make a `Sensor` of flat parameters ('sensor.serial', 'bias.offset_v', ...), all checked.

    Parameters
    ----------
    flat
        As in the file, nested keys joined by dots; other nodes' keys may be among them.
    fail
        Callable (key, reason) that returns the exception to raise.

    """
    if flat.get('format') != FORMAT:
        raise fail('format', f'version {flat.get("format")!r}, but this package reads version '
                             f'{FORMAT}; fit the calibration again, or update the package')
    if flat.get('units', UNITS) != UNITS:
        raise fail('units', f'{flat["units"]!r}, but coefficients are in {UNITS!r}')
    figures = {f.name: _figure(f, flat, fail) for f in FIGURES.values()}
    count = len(figures['axes'])
    for f in FIGURES.values():
        value = figures[f.name]
        if isinstance(value, np.ndarray) and len(value) != count:
            raise fail(f.metadata['key'], f'{len(value)} values for {count} axes '
                                          f'({figures["axes"]})')
    if figures['z_sign'] == 0:
        raise fail('sensor.z_sign', '0, but must be 1 (upright) or -1')
    names = _strings('effects', flat, fail)
    values = {name: _effect_values(name, figures['axes'], flat, fail) for name in names}
    covariance, covariance_names = _covariance(flat, values, figures['axes'], fail)
    provenance = {key.removeprefix('provenance.'): str(value) for key, value in flat.items()
                  if key.startswith('provenance.')}
    name, datasheet = _datasheet(flat, fail)
    return Sensor(**figures, effects=names, values=values, covariance=covariance,
                  covariance_names=covariance_names, provenance=provenance,
                  envelope=_envelope(flat, fail), datasheet_name=name, datasheet=datasheet)


def to_flat(sensor: Sensor) -> dict[str, Any]:
    """Flatten a sensor to the parameters of its file, plain Python values, in file order."""
    flat: dict[str, Any] = {'format': FORMAT, 'units': UNITS, 'model': sensor.model}
    for key, f in FIGURES.items():
        value = getattr(sensor, f.name)
        flat[key] = value.tolist() if isinstance(value, np.ndarray) else value
    if sensor.effects:
        flat['effects'] = list(sensor.effects)
    for name in sensor.effects:
        for parameter, value in sensor.values[name].items():
            flat[str(Coefficient(name, parameter))] = np.asarray(value, float).tolist()
    if sensor.covariance_names:
        flat['covariance_names'] = [str(name) for name in sensor.covariance_names]
        flat['covariance'] = [float(v) for v in sensor.covariance.ravel()]
    for key in ENVELOPE:
        figure = getattr(sensor.envelope, key)
        if figure:
            flat[f'envelope.{key}'] = list(figure) if key in ENVELOPE_LISTS else figure
    for key, text in sensor.provenance.items():
        flat[f'provenance.{key}'] = text
    if sensor.datasheet:
        typical, maximum = zip(*sensor.datasheet.values())
        flat |= {'datasheet.name': sensor.datasheet_name,
                 'datasheet.figures': [str(name) for name in sensor.datasheet],
                 'datasheet.typical': list(typical), 'datasheet.maximum': list(maximum)}
    return flat


def save(path: str | os.PathLike, sensor: Sensor, comments: Iterable[str] = ()) -> None:
    """
    Write a parameter file, whole or not at all; floats round-trip.

    Parameters
    ----------
    path
        The file to write.
    sensor
        What it shall hold.
    comments
        Lines for people, put before the parameters.

    """
    tree: dict[str, Any] = {}
    for key, value in to_flat(sensor).items():
        *parents, leaf = key.split('.')
        below = tree
        for parent in parents:
            below = below.setdefault(parent, {})
        below[leaf] = value
    text = yaml.dump({'/**': {'ros__parameters': tree}}, Dumper=_Dumper, sort_keys=False,
                     default_flow_style=None, width=99, allow_unicode=True)
    with atomic_path(path) as fresh:
        fresh.write_text(''.join(f'# {line}\n' for line in comments) + text, encoding='utf-8')


class _Dumper(yaml.SafeDumper):
    """Writes floats so that ROS reads doubles (1.0, not 1; 1.0e-06, not 1e-06)."""


def _float_text(value: float) -> str:
    text = repr(value)
    return text if '.' in text else text.replace('e', '.0e')


def _represent_float(dumper: yaml.SafeDumper, value: float) -> yaml.Node:
    return dumper.represent_scalar('tag:yaml.org,2002:float', _float_text(value))


_Dumper.add_representer(float, _represent_float)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Flatten /**: ros__parameters: to dotted keys; return values, and the places of keys."""
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, 'strerror', None) or 'not UTF-8 text'
        raise UserError(f'{path}: cannot be read: {reason}') from None
    flat: dict[str, Any] = {}
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        for key in ('/**', 'ros__parameters'):
            root = _child(root, key, path)
        marks = {'': root.start_mark}
        _flatten(root, '', flat, marks, path)
    except yaml.YAMLError as error:
        problem = ' '.join(str(getattr(error, 'problem', error)).split())
        raise UserError(f'{_where(path, getattr(error, "problem_mark", None))}: not YAML: '
                        f'{problem}') from None
    except RecursionError:
        raise UserError(f'{path}: a node contains itself') from None
    return flat, marks


def _where(path: str | os.PathLike, mark: Any) -> str:
    return f'{path}:{mark.line + 1}:{mark.column + 1}' if mark else f'{path}'


def _child(node: Any, key: str, path: Path) -> Any:
    if isinstance(node, yaml.MappingNode):
        for name, value in node.value:
            if name.value == key and isinstance(value, yaml.MappingNode):
                return value
    raise UserError(f'{_where(path, node and node.start_mark)}: no {key!r} with parameters below '
                    "it; a parameter file begins with '/**:' and 'ros__parameters:'")


def _flatten(node: yaml.MappingNode, prefix: str, flat: dict, marks: dict, path: Path) -> None:
    for name, value in node.value:
        key = f'{prefix}{name.value}'
        if key in marks:
            raise UserError(f'{_where(path, name.start_mark)}: {key}: stands twice; keep one')
        if isinstance(value, yaml.MappingNode):
            marks[key] = name.start_mark
            _flatten(value, f'{key}.', flat, marks, path)
        else:
            marks[key] = value.start_mark
            flat[key] = yaml.constructor.SafeConstructor().construct_object(value, deep=True)


def _figure(f: Any, flat: dict, fail: Any) -> Any:
    key, kind = f.metadata['key'], f.type
    if key not in flat:
        raise fail(key, f'missing; it is the {f.metadata["doc"]}')
    value = flat[key]
    if kind == 'np.ndarray':
        value = _floats(key, value, fail)
    elif kind == 'float':
        value = _floats(key, [value], fail)[0].item()
    elif not isinstance(value, {'int': int, 'str': str}[kind]) or isinstance(value, bool):
        raise fail(key, f'{value!r} is not {"a whole number" if kind == "int" else "text"}')
    _bounded(key, value, f.metadata, fail)
    return value


def _bounded(key: str, value: Any, limits: Any, fail: Any) -> None:
    if limits['choices'] and value not in limits['choices']:
        raise fail(key, f'{value!r} is not one of {", ".join(limits["choices"])}')
    if limits['lower'] is None:
        return
    for one in np.ravel(value):
        if not limits['lower'] <= one <= limits['upper']:
            raise fail(key, f'{one:g} {limits["unit"]} is outside {limits["lower"]:g} to '
                            f'{limits["upper"]:g}')


def _floats(key: str, value: Any, fail: Any) -> np.ndarray:
    many = value if isinstance(value, (list, tuple, np.ndarray)) else [value]
    for one in many:
        if isinstance(one, bool) or not isinstance(one, float):
            raise fail(key, f'{one!r} is not a floating-point number{_as_float(one)}')
        if not np.isfinite(one):
            raise fail(key, f'{one} is not a finite number')
    return np.array(many, float)


def _as_float(value: Any) -> str:
    """Suggest what to write for an integer, or for 1e-6, which YAML reads as text."""
    try:
        return f'; write {_float_text(float(value))}'
    except (TypeError, ValueError):
        return ''


def _strings(key: str, flat: dict, fail: Any) -> tuple[str, ...]:
    value = flat.get(key) or []
    if not isinstance(value, (list, tuple)) or not all(isinstance(one, str) for one in value):
        raise fail(key, f'{value!r} is not a list of names')
    if len(set(value)) != len(value):
        raise fail(key, 'names one twice')
    return tuple(value)


def _effect_values(name: str, axes: str, flat: dict, fail: Any) -> dict[str, np.ndarray]:
    try:
        effect = effect_named(name)
    except UserError as error:
        raise fail('effects', str(error)) from None
    values = {}
    for parameter in effect.parameters:
        key = str(Coefficient(name, parameter.name))
        if key not in flat and parameter.role is Role.OPTIONAL:
            values[parameter.name] = neutral(effect, axes)[parameter.name]
            continue
        if key not in flat:
            raise fail(key, f'missing; it is the {parameter.doc}, {parameter.unit}'
                            f'{", by axis" if parameter.axes else ""}')
        array = _floats(key, flat[key], fail)
        if parameter.axes and len(array) != len(axes):
            raise fail(key, f'{len(array)} values for {len(axes)} axes ({axes})')
        if not parameter.axes and isinstance(flat[key], (list, tuple)):
            raise fail(key, f'{flat[key]} is a list; it is one number without axes')
        _bounded(key, array, {'choices': (), 'lower': parameter.lower,
                              'upper': parameter.upper, 'unit': parameter.unit}, fail)
        for axis, value in zip(axes if parameter.axes else '', array):
            if axis not in parameter.axes and value != parameter.neutral:
                raise fail(key, f'{value:g} for {axis}, which it does not act on; write '
                                f'{parameter.neutral!r}')
        values[parameter.name] = array if parameter.axes else array[0]
    known = {p.name for p in effect.parameters}
    for key in flat:
        if key.startswith(f'{name}.') and key.removeprefix(f'{name}.') not in known:
            raise fail(key, f'unknown parameter; {name} has {", ".join(sorted(known))}')
    return values


def _covariance(flat: dict, values: dict, axes: str, fail: Any) -> tuple:
    names = _strings('covariance_names', flat, fail)
    known = {str(name): name for effect in values
             for name in names_of(effect_named(effect), axes)}
    for name in names:
        if name not in known:
            raise fail('covariance_names', f'{name!r} is no parameter of the listed effects')
    if not names:
        return np.zeros((0, 0)), ()
    if 'covariance' not in flat:
        raise fail('covariance', f'missing; {len(names)} names stand in covariance_names')
    matrix = _floats('covariance', flat['covariance'], fail)
    if matrix.size != len(names) ** 2:
        raise fail('covariance', f'{matrix.size} values, but {len(names)} names need '
                                 f'{len(names) ** 2}')
    matrix = matrix.reshape(len(names), -1)
    for name, variance in zip(names, np.diag(matrix)):
        if variance < 0:
            raise fail('covariance', f'the variance of {name} is {variance:g}, not positive')
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    relative = matrix / np.outer(scale, scale)
    if np.abs(relative - relative.T).max() > 1e-6:
        raise fail('covariance', 'not symmetric')
    smallest = np.linalg.eigvalsh(relative).min()
    if smallest < -1e-9:
        raise fail('covariance', f'not positive: its smallest eigenvalue is {smallest:.3g} in '
                                 'units of the variances')
    return matrix, tuple(known[name] for name in names)


def _envelope(flat: dict, fail: Any) -> Envelope:
    found: dict[str, Any] = {}
    for key in ENVELOPE:
        name = f'envelope.{key}'
        if name not in flat:
            continue
        values = _floats(name, flat[name], fail)
        count = ENVELOPE_LISTS.get(key, 1)
        if len(values) != count or (count == 1 and values[0] < 0) or \
                (key == 'temperature_c' and values[0] > values[1]):
            raise fail(name, f'{flat[name]} is not the {ENVELOPE[key]}')
        found[key] = float(values[0]) if count == 1 else tuple(values.tolist())
    return Envelope(**found)


def _datasheet(flat: dict, fail: Any) -> tuple[str, dict[Coefficient, tuple[float, float]]]:
    if 'datasheet.figures' not in flat:
        return '', {}
    names = _strings('datasheet.figures', flat, fail)
    columns = []
    for key in ('typical', 'maximum'):
        of = f'datasheet.{key}'
        if of not in flat:
            raise fail(of, f'missing; {len(names)} names stand in datasheet.figures')
        values = _floats(of, flat[of], fail)
        if len(values) != len(names) or (values < 0).any():
            raise fail(of, f'{len(values)} values, but {len(names)} names need as many, of 0 or '
                           'more')
        columns.append(values.tolist())
    for name in names:
        effect, _, parameter = name.partition('.')
        try:
            known = {p.name for p in effect_named(effect).parameters}
        except UserError as error:
            raise fail('datasheet.figures', str(error)) from None
        if parameter not in known:
            raise fail('datasheet.figures', f'{name!r} is no parameter of {effect}')
    figures = dict(zip(map(Coefficient.parse, names), zip(*columns)))
    return str(flat.get('datasheet.name', '')), figures
