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

"""What every node shares: parameters with descriptors, QoS, diagnostics, a clean start and end."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
import signal
import sys
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor
from ament_index_python.packages import get_package_share_directory
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.utilities import remove_ros_args
import yaml

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
_KINDS = {'np.ndarray': Parameter.Type.DOUBLE_ARRAY, 'float': Parameter.Type.DOUBLE,
          'int': Parameter.Type.INTEGER, 'str': Parameter.Type.STRING}


class NotForExecutors(CallbackGroup):
    """Keeps a subscription out of the executor that spins its node, for a thread to take from."""

    def can_execute(self, entity: Any) -> bool:
        """Say no."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Say no."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Do nothing: nothing was executed."""


def main(make_node: Callable[[], Node], about: str | None) -> int:
    """
    Run one node until SIGINT or SIGTERM; return the exit status.

    Parameters
    ----------
    make_node
        Creates the node; it may raise `UserError`, and may have a method `close()`.
    about
        What `--help` prints.

    Returns
    -------
    int
        0 ended by a signal, 1 could not start (one line on stderr says why), 2 wrong usage.

    """
    name = Path(sys.argv[0]).name
    # rclpy's own handler ends the context; Python's would raise in the middle of any statement.
    signal.signal(signal.SIGINT, lambda *_: None)
    try:
        _check_files()
        argparse.ArgumentParser(
            prog=name, description=about, usage='%(prog)s [--ros-args -p NAME:=VALUE ... '
            '--params-file FILE -r FROM:=TO ...]').parse_args(remove_ros_args(sys.argv)[1:])
        rclpy.init()
        node = make_node()
    except Exception as error:
        if not isinstance(error, UserError) and not type(error).__module__.startswith('rclpy'):
            raise
        print(f'{name}: {_one_line(error)}', file=sys.stderr)
        return 2 if 'ROSArgs' in type(error).__name__ else 1
    try:
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.spin()
    except ExternalShutdownException:
        pass
    except Exception:
        # After the signal nothing can be published: what fails then is the end, not an error.
        if rclpy.ok():
            raise
    finally:
        getattr(node, 'close', lambda: None)()
        rclpy.try_shutdown()
        # A launch passes Ctrl-C on, which the terminal has sent, too: the second one may come
        # when Python has already put its handlers away.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return 0


def declare(node: Node, name: str, default: Any, doc: str, unit: str = '',
            lower: float | None = None, upper: float | None = None,
            choices: Sequence[str] = (), live: bool = False) -> Any:
    """
    Declare one parameter with its descriptor and return its value.

    Parameters
    ----------
    node, name
        Whose parameter, and its name.
    default
        The value, or a `Parameter.Type` for a parameter that has none; an empty tuple for a list
        of strings, or one string with commas.
    doc, unit
        What it is, for the descriptor.
    lower, upper, choices
        What it may be.
    live
        Whether it can be set while the node runs.

    Returns
    -------
    Any
        bool, int, float, str or a list of them; None where there is no value.

    Raises
    ------
    UserError
        The value given has another type, or is out of range or not among the choices.

    """
    either = isinstance(default, tuple)
    if either:
        default = ''
    kind = default if isinstance(default, Parameter.Type) else \
        Parameter.Type.from_parameter_value(default)
    limits = '' if lower is None else f'{lower:g} to {upper:g}'
    one_of = 'one of ' + ', '.join(choices) if choices else ''
    descriptor = ParameterDescriptor(
        description=', '.join(filter(None, (doc, unit))), read_only=not live,
        dynamic_typing=either,
        additional_constraints=one_of or limits)
    if lower is not None and upper is not None:
        if kind == Parameter.Type.DOUBLE:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(lower), to_value=float(upper))]
        elif kind == Parameter.Type.INTEGER:
            descriptor.integer_range = [IntegerRange(from_value=int(lower), to_value=int(upper))]
    try:
        value = node.declare_parameter(name, default, descriptor).value
    except ParameterException as error:
        raise fail(name, _one_line(error)) from None
    if choices and value is not None and value not in choices:
        raise fail(name, f'{value!r} is not {one_of}')
    return value


def declare_sensor(node: Node, live: bool = False) -> dict[str, Any]:
    """
    Declare everything that a parameter file holds and return what is given, by dotted key.

    Where `format` is given the parameters come from a parameter file, and what it lacks stays
    away, for `make_sensor` to refuse; otherwise the installed nominal sensor fills in.

    Parameters
    ----------
    node
        Which declares them.
    live
        Whether they can be set while the node runs; the node's callbacks say which, and how.

    """
    kind = Parameter.Type
    flat = {'format': declare(node, 'format', kind.INTEGER, 'version of the parameter file',
                              live=live)}
    nominal = {} if flat['format'] is not None else parameter_file.to_flat(
        parameter_file.load(nominal_path()))
    flat['format'] = nominal.get('format', flat['format'])
    flat['units'] = declare(node, 'units', parameter_file.UNITS, 'units of the coefficients',
                            live=live)
    for key, f in parameter_file.FIGURES.items():
        about = f.metadata
        flat[key] = declare(node, key, nominal.get(key, _KINDS[f.type]), about['doc'],
                            about['unit'], about['lower'], about['upper'], about['choices'],
                            live)
    coefficients = [('effects', kind.STRING_ARRAY, 'effects that this unit has', '', None, None)]
    for effect in library().values():
        coefficients += [(f'{effect.name}.{p.name}', kind.DOUBLE_ARRAY if p.axes else kind.DOUBLE,
                          f'{p.doc}, by axis' if p.axes else p.doc,
                          p.unit, p.lower, p.upper) for p in effect.parameters]
    coefficients += [
        ('covariance_names', kind.STRING_ARRAY, 'coefficients in the covariance', '', None, None),
        ('covariance', kind.DOUBLE_ARRAY, 'of the coefficients, rows flattened', '', None, None)]
    coefficients += [(f'envelope.{key}', kind.DOUBLE_ARRAY if key in parameter_file.ENVELOPE_LISTS
                      else kind.DOUBLE, doc, '', None, None)
                     for key, doc in parameter_file.ENVELOPE.items()]
    for key, doc in parameter_file.DATASHEET.items():
        of_kind = {'name': kind.STRING, 'figures': kind.STRING_ARRAY}.get(key, kind.DOUBLE_ARRAY)
        coefficients.append((f'datasheet.{key}', of_kind, doc, '', None, None))
    for key, of_kind, doc, unit, lower, upper in coefficients:
        flat[key] = declare(node, key, nominal.get(key, of_kind), doc, unit, lower, upper,
                            live=live)
    return {key: value for key, value in flat.items() if value is not None}


def make_sensor(flat: Mapping[str, Any],
                refuse: Callable[[str, str], UserError] | None = None) -> Sensor:
    """
    Check the parameters that `declare_sensor` returns; raises `UserError`.

    Parameters
    ----------
    flat
        Values by dotted key.
    refuse
        Makes the error of a parameter and a reason; by default it names its parameter file.

    """
    listed = flat.get('effects', [])
    # Coefficients of an effect that is not listed have no part in this sensor.
    unused = {f'{e.name}.{p.name}' for e in library().values() if e.name not in listed
              for p in e.parameters}
    return parameter_file.from_flat(
        {k: v for k, v in flat.items() if k not in unused}, refuse or fail)


def nominal_path() -> Path:
    """Where the nominal sensor is installed."""
    return Path(get_package_share_directory('adxl_ros')) / 'params' / 'adxl203.yaml'


def fail(key: str, why: str) -> UserError:
    """Name the parameter and, when it comes from a file, the place in it."""
    return UserError(f'{_place(key)}{key}: {why}')


def publisher(node: Node, kind: Any, topic: str, depth: int, latched: bool = False) -> Publisher:
    """Create a reliable keep-last publisher whose QoS can be overridden by parameters."""
    qos = QoSProfile(depth=depth)
    if latched:
        qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return node.create_publisher(
        kind, topic, qos, qos_overriding_options=QoSOverridingOptions.with_default_policies())


def subscription(node: Node, kind: Any, topic: str, callback: Callable, depth: int,
                 latched: bool = False, raw: bool = False,
                 group: CallbackGroup | None = None) -> Subscription:
    """
    Subscribe best effort, so that both kinds of publisher connect; QoS can be overridden.

    The callback gets one message at a time, and all that have arrived at a turn of the executor:
    a turn costs as much as ten messages, and a node that takes one a turn cannot follow 10 kHz.

    Parameters
    ----------
    node, kind, topic, depth
        As `Node.create_subscription` takes them.
    callback
        Takes a message, or its bytes.
    depth
        Messages that are kept while the node is busy, and the most that one turn takes.
    latched
        Whether to get what was published before: reliable and transient local.
    raw
        Whether the callback gets serialized messages.
    group
        Its callback group, if not the node's own.

    """
    def drain(first: Any) -> None:
        callback(first)
        with made.handle:
            for _ in range(depth):
                taken = made.handle.take_message(kind, raw)
                if taken is None:
                    break
                callback(taken[0])

    qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)
    if latched:
        qos = QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    made = node.create_subscription(
        kind, topic, drain, qos, raw=raw, callback_group=group,
        qos_overriding_options=QoSOverridingOptions.with_default_policies())
    return made


def status(level: bytes, name: str, message: str, hardware_id: str,
           values: Mapping[str, Any]) -> DiagnosticStatus:
    """Make a diagnostic status; floats keep every digit."""
    return DiagnosticStatus(level=level, name=name, message=message, hardware_id=hardware_id,
                            values=[KeyValue(key=key, value=value if isinstance(value, str)
                                             else repr(value)) for key, value in values.items()])


def diagnostics(node: Node, *statuses: DiagnosticStatus) -> DiagnosticArray:
    """Put statuses under the present ROS time; their names get the node's in front."""
    array = DiagnosticArray(status=list(statuses))
    array.header.stamp = node.get_clock().now().to_msg()
    for one in statuses:
        one.name = f'{node.get_fully_qualified_name().lstrip("/")}: {one.name}'
    return array


def _one_line(error: Exception) -> str:
    return ' '.join(str(error).split())


def _files() -> list[str]:
    return [path for flag, path in zip(sys.argv, sys.argv[1:]) if flag == '--params-file']


def _check_files() -> None:
    """Say with line and column what rcl's reader of parameter files would refuse without."""
    for path in _files():
        _check(path, _tree(path))


def _tree(path: str) -> Any:
    try:
        return yaml.compose(Path(path).read_text(encoding='utf-8'), yaml.SafeLoader)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, 'strerror', None) or 'not UTF-8 text'
        raise UserError(f'{path}: cannot be read: {reason}') from None
    except yaml.YAMLError as error:
        mark = getattr(error, 'problem_mark', None)
        place = f':{mark.line + 1}:{mark.column + 1}' if mark else ''
        raise UserError(f'{path}{place}: not YAML: {getattr(error, "problem", error)}') from None


def _check(path: str, node: Any) -> None:
    if isinstance(node, yaml.MappingNode):
        for _, value in node.value:
            _check(path, value)
    elif isinstance(node, yaml.SequenceNode):
        for one in node.value[1:]:
            if one.tag != node.value[0].tag:
                mark = one.start_mark
                raise UserError(
                    f'{path}:{mark.line + 1}:{mark.column + 1}: {one.value} is not of the type '
                    f'of {node.value[0].value} before it; a list has one type (1.0, never 1)')


def _place(key: str) -> str:
    """Find a parameter in the files of --params-file: 'file:line:column: ', or ''."""
    for path in reversed(_files()):
        mark = _mark(_tree(path), key)
        return f'{path}:{mark.line + 1}:{mark.column + 1}: ' if mark else f'{path}: '
    return ''


def _mark(node: Any, key: str) -> Any:
    """Find the place of a dotted key's value at any depth of a YAML tree."""
    if not isinstance(node, yaml.MappingNode):
        return None
    for name, value in node.value:
        if name.value == key:
            return value.start_mark
        rest = key.removeprefix(f'{name.value}.')
        mark = _mark(value, rest) or (_mark(value, key) if rest != key else None)
        if mark:
            return mark
    return None
