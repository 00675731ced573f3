# SPDX-License-Identifier: Apache-2.0

"""
The parameter file of a sensor: read with one check for nodes and tools, and written.

It is a YAML file that ROS nodes can load: flat keys below `/**: ros__parameters:`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, Field, fields, MISSING
from pathlib import Path
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import AnyPath, write_text
from adxl_ros.model.constants import AXES
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, Effect, Parameter, Role
from adxl_ros.model.gyroscope import Gyroscope
from adxl_ros.model.sensor import coefficients_of, Envelope, neutral, Sensor
from adxl_ros.report.arguments import require_path
import numpy as np
import yaml

FORMAT = 1  # Version of the format. A file of another version is refused

COEFFICIENT_UNITS = 'V, V/g, 1/g, rad'
"""Units of the coefficients: written into every file, and checked."""

SENSOR_FIELDS: dict[str, Field[Any]] = {
    field.metadata['key']: field for field in fields(Sensor) if field.metadata
}
"""Fields of `Sensor` by key; the metadata hold unit, bounds and meaning."""

ENVELOPE = {
    'temperature_c': 'lowest and highest temperature of the poses, degC',
    'zero_g_per_k': 'drift of the zero-g beyond them, g/K',
    'scale_per_k': 'drift of the scale factor beyond them, 1/K',
    'zero_g_nodes_c': 'temperatures at which the next degree of the zero-g departs by 0, degC',
    'zero_g_next': 'size of that next degree by axis, g/K^n for n such temperatures',
    'zero_g_at_c': 'temperature at which the zero-g is known, degC',
    'misfit_mps2': 'error of held-out poses beyond noise and stage, m/s^2',
    'force_low_mps2': 'lowest specific force of the poses by component, m/s^2',
    'force_high_mps2': 'highest specific force of the poses by component, m/s^2',
}
"""Meaning of the keys `envelope.*`, those of `model.sensor.Envelope`; each may be missing."""

ENVELOPE_LISTS = {
    'temperature_c': 2,
    'force_low_mps2': 3,
    'force_high_mps2': 3,
    'zero_g_nodes_c': 3,
    'zero_g_next': 0,
}
"""Number of values of the keys `envelope.*` that have more than one; 0 is one for each axis."""

GYRO = {field.name: field.metadata for field in fields(Gyroscope)}
"""Meaning and unit of the keys `gyro.*`, three numbers each; each may be missing."""

DATASHEET = {
    'name': 'datasheet that the values are from',
    'figures': 'effect.parameter that the datasheet bounds',
    'typical': 'typical departures, 0.0 where not stated',
    'maximum': 'greatest departures, 0.0 where not stated',
}
"""Meaning of the keys `datasheet.*`; a file has all of them or none."""

_LINK = 'link.'  # Begin of keys that a file carries unchecked: the driver checks them
_MOUNTING = 'mounting.'  # The same of keys that the compensation checks

_SMALLEST_VARIANCE = 1e-300
"""Smaller variances count as this in the check of a covariance (chosen: near the smallest
float64, so that a variance of 0 divides nothing by 0)."""

_ROUNDING = 1e-6
"""Permitted asymmetry of a correlation matrix, and its eigenvalues below 0 (chosen: far above the
digits that a file holds)."""

MakeError = Callable[[str, str], Exception]  # Makes the exception to raise from a key and a reason


def nominal_path() -> Path:
    """Return the installed file of the default sensor; no other place in the code names one."""
    return _params_folder() / 'adxl203.yaml'


def _params_folder() -> Path:
    """Return the folder of the installed parameter files: as ROS has it, else the package's."""
    with suppress(ImportError, LookupError, OSError):
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory('adxl_ros')) / 'params'
    package = Path(__file__).resolve().parents[1]
    return next(
        (folder for folder in (package / 'params', package.parent / 'params') if folder.is_dir()),
        package / 'params',
    )


def installed_path(name: AnyPath) -> Path:
    """Return the installed file of a sensor by its name, such as MPU-6050; a path stays."""
    path = require_path(name)
    may_be_name = path.name == str(name) and not path.suffix
    if path.exists() or not may_be_name:
        return path
    folder = _params_folder()
    file = folder / f'{path.name.lower().replace("-", "")}.yaml'
    if not file.exists():
        names = ', '.join(sorted(other.stem for other in folder.glob('*.yaml')))
        raise UserError(f'{name}: no file, and no sensor of this name; sensors: {names}')
    return file


def load(path: AnyPath, may_measure: bool = False) -> Sensor:
    """
    Read and check the parameter file of a sensor, by its path or its name.

    may_measure: whether keys may be missing that a recording can show.
    """
    path = installed_path(path)
    flat, marks = _read(path)

    def make_error(key: str, reason: str) -> UserError:
        # A missing key has no place of its own: name that of its parent.
        place = key
        while place not in marks:
            place = place.rpartition('.')[0]
        return UserError(f'{_where(path, marks[place])}: {key}: {reason}')

    return from_flat(flat, make_error, may_measure)


def usual_path(is_nominal: bool) -> Path:
    """Return the path of the nominal sensor, or that of a stream that states nothing of itself."""
    return nominal_path() if is_nominal else _params_folder() / 'any_imu.yaml'


def usual(is_nominal: bool) -> Sensor:
    """Return the nominal sensor, or any IMU."""
    return load(usual_path(is_nominal), may_measure=True)


def from_flat(flat: Mapping[str, Any], make_error: MakeError, may_measure: bool = False) -> Sensor:
    """Make a `Sensor` of flat parameters by dotted key, which keys of nodes may be among."""
    if flat.get('format') != FORMAT:
        raise make_error(
            'format',
            f'version {flat.get("format")!r}, but this package reads '
            f'version {FORMAT}; fit the calibration again, or update the package',
        )
    if flat.get('units', COEFFICIENT_UNITS) != COEFFICIENT_UNITS:
        raise make_error(
            'units', f'{flat["units"]!r}, but coefficients are in {COEFFICIENT_UNITS!r}'
        )
    return _FlatReader(flat, make_error).sensor(may_measure)


def to_flat(sensor: Sensor) -> dict[str, Any]:
    """Return the parameters of a sensor's file by dotted key, plain Python values, in order."""
    flat: dict[str, Any] = {'format': FORMAT, 'units': COEFFICIENT_UNITS, 'model': sensor.model}
    for key, field in SENSOR_FIELDS.items():
        value = getattr(sensor, field.name)
        is_default = field.default is not MISSING and value == field.default
        if field.name not in sensor.unstated and not is_default:
            flat[key] = value if isinstance(value, str) else np.asarray(value).tolist()
    flat |= {f'{_LINK}{name}': value for name, value in sensor.link.items()}
    flat |= {f'{_MOUNTING}{name}': value for name, value in sensor.mounting.items()}
    if sensor.effects:
        flat['effects'] = list(sensor.effects)
    for name in sensor.effects:
        for parameter, value in sensor.values[name].items():
            flat[str(Coefficient(name, parameter))] = np.asarray(value, float).tolist()
    if sensor.covariance_names:
        flat['covariance_names'] = [str(name) for name in sensor.covariance_names]
        flat['covariance'] = [float(value) for value in sensor.covariance.ravel()]
    for key in ENVELOPE:
        value = getattr(sensor.envelope, key)
        if value:
            flat[f'envelope.{key}'] = list(value) if key in ENVELOPE_LISTS else value
    flat |= _gyro_flat(sensor.gyro)
    for key, text in sensor.provenance.items():
        flat[f'provenance.{key}'] = text
    if sensor.datasheet:
        typical, maximum = zip(*sensor.datasheet.values())
        flat |= {
            'datasheet.name': sensor.datasheet_name,
            'datasheet.figures': [str(name) for name in sensor.datasheet],
            'datasheet.typical': list(typical),
            'datasheet.maximum': list(maximum),
        }
    return flat


def _gyro_flat(gyro: Gyroscope) -> dict[str, Any]:
    """Return what is known of a gyroscope by dotted key."""
    values = {f'gyro.{name}': list(getattr(gyro, name)) for name in GYRO}
    return {key: value for key, value in values.items() if value}


def save(path: AnyPath, sensor: Sensor, comments: Iterable[str] = ()) -> None:
    """Write a parameter file, with comments for people; reading it gives the same floats."""
    write_text(path, as_text(sensor, comments))


def as_text(sensor: Sensor, comments: Iterable[str] = ()) -> str:
    """Return the text of a parameter file."""
    tree: dict[str, Any] = {}
    for key, value in to_flat(sensor).items():
        *parents, leaf = key.split('.')
        branch = tree
        for parent in parents:
            branch = branch.setdefault(parent, {})
        branch[leaf] = value
    text = yaml.dump(
        {'/**': {'ros__parameters': tree}},
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        width=99,
        allow_unicode=True,
    )
    return ''.join(f'# {line}\n' for line in comments) + text


class _Dumper(yaml.SafeDumper):
    """Writes floats so that ROS reads doubles (1.0, not 1; 1.0e-06, not 1e-06)."""


def float_text(value: float) -> str:
    """Return a number as YAML that ROS reads as a double."""
    text = repr(value)
    return text if '.' in text else text.replace('e', '.0e')


_Dumper.add_representer(
    float,
    lambda dumper, value: dumper.represent_scalar('tag:yaml.org,2002:float', float_text(value)),
)


def compose(path: AnyPath) -> yaml.Node | None:
    """Read a YAML file as a tree of nodes, which know their places; None for an empty file."""
    try:
        return yaml.compose(Path(path).read_text(encoding='utf-8'), Loader=yaml.SafeLoader)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else 'not UTF-8 text'
        raise UserError(f'{path}: cannot be read: {reason}') from None
    except yaml.YAMLError as error:
        problem = ' '.join(str(getattr(error, 'problem', error)).split())
        place = _where(path, getattr(error, 'problem_mark', None))
        raise UserError(f'{place}: not YAML: {problem}') from None


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return values and places by dotted key, from below `/**: ros__parameters:`."""
    parameters: Any = compose(path)
    for key in ('/**', 'ros__parameters'):
        children = parameters.value if isinstance(parameters, yaml.MappingNode) else ()
        below = next((value for name, value in children if name.value == key), None)
        if not isinstance(below, yaml.MappingNode):
            place = _where(path, parameters and parameters.start_mark)
            raise UserError(
                f'{place}: no {key!r} with parameters below it; a parameter file '
                "begins with '/**:' and 'ros__parameters:'"
            )
        parameters = below
    flat: dict[str, Any] = {}
    marks = {'': parameters.start_mark}
    _flatten(parameters, '', flat, marks, path)
    return flat, marks


def _where(path: AnyPath, mark: Any) -> str:
    """Return file:line:column of a mark of yaml; the file alone without a mark."""
    return f'{path}:{mark.line + 1}:{mark.column + 1}' if mark else f'{path}'


def _flatten(
    node: yaml.MappingNode, prefix: str, flat: dict[str, Any], marks: dict[str, Any], path: Path
) -> None:
    """Add the values and places below a node to `flat` and `marks`, by dotted key."""
    for name, value in node.value:
        key = f'{prefix}{name.value}'
        if key in marks:
            raise UserError(f'{_where(path, name.start_mark)}: {key}: stands twice; keep one')
        if isinstance(value, yaml.MappingNode):
            marks[key] = name.start_mark
            _flatten(value, f'{key}.', flat, marks, path)
        else:
            marks[key] = value.start_mark
            try:
                flat[key] = yaml.constructor.SafeConstructor().construct_object(value, deep=True)
            except (yaml.YAMLError, ValueError) as error:
                problem = getattr(error, 'problem', error)
                raise UserError(f'{_where(path, value.start_mark)}: not YAML: {problem}') from None


@dataclass(frozen=True)
class _FlatReader:
    """Reads and checks flat parameters."""

    flat: Mapping[str, Any]
    make_error: MakeError

    def sensor(self, may_measure: bool) -> Sensor:
        """Make the sensor; every value is checked."""
        # The axes come first, as they say how many values the others have.
        axes = self._field(SENSOR_FIELDS['sensor.axes'])
        values: dict[str, Any] = {}
        unstated = []
        for key, field in SENSOR_FIELDS.items():
            value = field.metadata['placeholder']
            can_measure = may_measure and value is not None
            if can_measure and key not in self.flat:
                unstated.append(field.name)
                is_array = field.type == 'np.ndarray'
                values[field.name] = np.full(len(axes), value) if is_array else value
            elif key in self.flat or field.default is MISSING:
                values[field.name] = self._field(field, axes)
        effects = self._names('effects')
        coefficients = {name: self._coefficients(name, axes) for name in effects}
        covariance, covariance_names = self._covariance(effects, axes)
        return Sensor(
            **values,
            effects=effects,
            values=coefficients,
            covariance=covariance,
            covariance_names=covariance_names,
            envelope=self._envelope(),
            gyro=self._gyro(),
            provenance={key: str(value) for key, value in self._below('provenance.').items()},
            datasheet_name=str(self.flat.get('datasheet.name', '')),
            datasheet=self._datasheet(),
            link=self._below(_LINK),
            mounting=self._below(_MOUNTING),
            unstated=tuple(unstated),
        )

    def _require(self, is_right: Any, key: str, reason: str) -> None:
        if not is_right:
            raise self.make_error(key, reason)

    def _below(self, begin: str) -> dict[str, Any]:
        """Return the values of the keys with this begin, by the rest of the key."""
        return {
            key.removeprefix(begin): value
            for key, value in self.flat.items()
            if key.startswith(begin)
        }

    def _field(self, field: Field[Any], axes: str = '') -> Any:
        """Return the value of a field of `Sensor`."""
        about = field.metadata
        kind = str(field.type)
        key = about['key']
        self._require(key in self.flat, key, f'missing; it is the {about["doc"]}')
        value = self.flat[key]
        if kind == 'np.ndarray':
            value = self._numbers(key, value, axes)
        elif kind.startswith('tuple'):
            # A node has an empty list where nothing is given.
            value = tuple(self._numbers(key, value, axes if value else '').tolist())
        elif kind == 'float':
            value = self._numbers(key, [value])[0].item()
        else:
            self._require(
                type(value) is {'int': int, 'str': str}[kind],
                key,
                f'{value!r} is not {"a whole number" if kind == "int" else "text"}',
            )
        choices = about['choices'] or [value]
        self._require(
            about['choices'] is None or value in choices,
            key,
            f'{value!r} is not one of {", ".join(map(str, choices))}',
        )
        if about['lower'] is not None:
            self._check_bounds(key, value, about['lower'], about['upper'], about['unit'])
        return value

    def _check_bounds(self, key: str, values: Any, lower: float, upper: float, unit: str) -> None:
        """Refuse values beyond their bounds."""
        for value in np.ravel(values):
            self._require(
                lower <= value <= upper, key, f'{value:g} {unit} is outside {lower:g} to {upper:g}'
            )

    def _numbers(self, key: str, value: Any, axes: str = '') -> np.ndarray:
        """Return a number or a list of numbers, one for each of the axes, as an array."""
        numbers = value if isinstance(value, (list, tuple, np.ndarray)) else [value]
        for number in numbers:
            self._require(
                isinstance(number, float),
                key,
                f'{number!r} is not a floating-point number; write it with a point, as '
                '1.0 and 1.0e-6',
            )
            self._require(np.isfinite(number), key, f'{number} is not a finite number')
        self._require(
            not axes or len(numbers) == len(axes),
            key,
            f'{len(numbers)} values for {len(axes)} axes ({axes})',
        )
        return np.array(numbers, float)

    def _names(self, key: str) -> tuple[str, ...]:
        """Return a list of different names; none where the key is missing."""
        names = self.flat.get(key) or []
        self._require(
            isinstance(names, (list, tuple)) and all(isinstance(n, str) for n in names),
            key,
            f'{names!r} is not a list of names',
        )
        self._require(len(set(names)) == len(names), key, 'a name stands twice')
        return tuple(names)

    def _effect(self, key: str, name: str) -> Effect:
        try:
            return effect_named(name)
        except UserError as error:
            raise self.make_error(key, str(error)) from None

    def _coefficients(self, name: str, axes: str) -> dict[str, np.ndarray]:
        """Return the values of an effect by parameter, (m,) or ()."""
        effect = self._effect('effects', name)
        values = {
            parameter.name: self._values(effect, parameter, axes)
            for parameter in effect.parameters
        }
        for parameter in self._below(f'{name}.'):
            self._require(
                parameter in values,
                f'{name}.{parameter}',
                f'unknown parameter; {name} has {", ".join(sorted(values))}',
            )
        return values

    def _values(self, effect: Effect, parameter: Parameter, axes: str) -> np.ndarray:
        """Return the value of a parameter by axis, (m,), or () where it has no axes."""
        key = str(Coefficient(effect.name, parameter.name))
        if key not in self.flat and parameter.role is Role.OPTIONAL:
            return neutral(effect, axes)[parameter.name]
        self._require(
            key in self.flat,
            key,
            f'missing; it is the {parameter.doc}, '
            f'{parameter.unit}{", by axis" if parameter.axes else ""}',
        )
        stated = self.flat[key]
        self._require(
            parameter.axes or not isinstance(stated, (list, tuple)),
            key,
            f'{stated} is a list; it is one number without axes',
        )
        values = self._numbers(key, stated, axes if parameter.axes else '')
        self._check_bounds(key, values, parameter.lower, parameter.upper, parameter.unit)
        if not parameter.axes:
            return values[0]
        for axis, value in zip(axes, values):
            self._require(
                axis in parameter.axes or value == parameter.neutral,
                key,
                f'{value:g} for {axis}, which it does not act on; write {parameter.neutral!r}',
            )
        return values

    def _covariance(
        self, effects: Sequence[str], axes: str
    ) -> tuple[np.ndarray, tuple[Coefficient, ...]]:
        """Return the covariance, (k, k), symmetric and positive, and its k coefficients."""
        key = 'covariance'
        names = self._names('covariance_names')
        coefficients = {str(name): name for name in coefficients_of(effects, axes)}
        for name in names:
            self._require(
                name in coefficients,
                'covariance_names',
                f'{name!r} is no parameter of the listed effects',
            )
        if not names:
            return np.zeros((0, 0)), ()
        self._require(
            key in self.flat, key, f'missing; {len(names)} names stand in covariance_names'
        )
        matrix = self._numbers(key, self.flat[key])
        self._require(
            matrix.size == len(names) ** 2,
            key,
            f'{matrix.size} values, but {len(names)} names need {len(names) ** 2}',
        )
        matrix = matrix.reshape(len(names), -1)
        std = np.sqrt(np.maximum(np.diag(matrix), _SMALLEST_VARIANCE))
        correlation = matrix / np.outer(std, std)
        asymmetry = np.abs(correlation - correlation.T).max()
        smallest = np.linalg.eigvalsh(correlation).min()
        self._require(
            asymmetry <= _ROUNDING and smallest >= -_ROUNDING,
            key,
            f'not symmetric and positive: its correlations differ by {asymmetry:.3g}, '
            f'their smallest eigenvalue is {smallest:.3g}; fit the calibration again',
        )
        return matrix, tuple(coefficients[name] for name in names)

    def _envelope(self) -> Envelope:
        """Return the validity range, as far as the file states it."""
        stated: dict[str, Any] = {}
        for name, meaning in ENVELOPE.items():
            key = f'envelope.{name}'
            if key in self.flat:
                values = self._numbers(key, self.flat[key])
                count = ENVELOPE_LISTS.get(name, 1) or len(self.flat['sensor.axes'])
                self._require(len(values) == count, key, f'{self.flat[key]} is not the {meaning}')
                stated[name] = values[0].item() if count == 1 else tuple(values.tolist())
        return Envelope(**stated)

    def _gyro(self) -> Gyroscope:
        """Return the gyroscope, as far as the file states it."""
        stated: dict[str, Any] = {}
        for name, about in GYRO.items():
            key = f'gyro.{name}'
            # A node has an empty list where nothing is given.
            if self.flat.get(key):
                values = self._numbers(key, self.flat[key])
                self._require(
                    len(values) == len(AXES),
                    key,
                    f'{len(values)} values, expected three: {about["doc"]}, {about["unit"]}',
                )
                self._require(about['has_sign'] or (values >= 0).all(), key, 'is below 0')
                stated[name] = tuple(values.tolist())
        return Gyroscope(**stated)

    def _datasheet(self) -> dict[Coefficient, tuple[float, float]]:
        """Return the typical and the greatest departure by `effect.parameter`."""
        names = self._names('datasheet.figures')
        for name in names:
            effect, _, parameter = name.partition('.')
            known = self._effect('datasheet.figures', effect).parameters
            self._require(
                parameter in [each.name for each in known],
                'datasheet.figures',
                f'{name!r} is no parameter of {effect}',
            )
        departures = []
        for key in ('datasheet.typical', 'datasheet.maximum') if names else ():
            values = self._numbers(key, self.flat.get(key, []))
            self._require(
                len(values) == len(names) and (values >= 0).all(),
                key,
                f'expected {len(names)} values of 0 or more, one for each name',
            )
            departures.append(values.tolist())
        return dict(zip(map(Coefficient.parse, names), zip(*departures)))
