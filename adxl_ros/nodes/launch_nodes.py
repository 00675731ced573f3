# SPDX-License-Identifier: Apache-2.0

"""What the launch files share: arguments, the parameters of each node, failed starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from itertools import chain, pairwise
from pathlib import Path
import sys
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.links.support.base import link_names
from adxl_ros.nodes import driver, stage
from adxl_ros.nodes.parameters import link_specs, Spec, specs_of
from adxl_ros.nodes.params_files import given_text, has_section
from launch.action import Action
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch.launch_context import LaunchContext
from launch.launch_description import LaunchDescription
from launch.logging import get_logger
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.utilities import prefix_namespace

_PACKAGE = 'adxl_ros'
_REFUSED_START = (1, 2)
"""Exit statuses of a node whose parameters are wrong. A signal or a failure later has others."""
_LIKENESS = 0.85
"""Likeness, 0 to 1, from which on an argument that is not known here seems to be misspelt; chosen:
one letter of seven is missing or wrong, and other words are less alike."""
_PUSHED = 'ros_namespace'
"""Where launch_ros keeps the namespace that a launch file around this one has pushed."""


class Argument(NamedTuple):
    """An argument of a launch that gives a parameter of a node."""

    name: str  # Its name
    spec: Spec  # The parameter

    def declared(self) -> DeclareLaunchArgument:
        """Return the action that declares it; an empty value leaves the parameter as it is."""
        return declared(
            self.name,
            '',
            f'{self.spec.meaning}; not given: as in params_file, or the default',
            *(('', *self.spec.choices) if self.spec.choices else ()),
        )

    def value(self, text: str) -> Any:
        """Return the value of the parameter."""
        default = self.spec.default
        # A list of numbers has a unit; names with commas stay one text.
        convert: Callable = str
        if default == () and self.spec.unit:
            convert = _numbers
        elif isinstance(default, int | float):
            convert = type(default)
        try:
            return convert(text)
        except ValueError:
            raise UserError(
                f'{self.name}:={text}: expected a number, or numbers with commas '
                'where it is a list'
            ) from None


def _numbers(text: str) -> list[float]:
    return [float(part) for part in text.strip('[]').split(',')]


def arguments(own: type, *parameters: str, **renamed: str) -> tuple[Argument, ...]:
    """
    Return arguments for parameters of a dataclass; those of the driver may be of any link.

    Dots in the name of a parameter become underscores, unless it is renamed.
    """
    specs = {spec.name: spec for spec in specs_of(own)}
    if own is driver.DriverSettings:
        for link in link_names():
            specs = {spec.name: spec for spec in link_specs(link)} | specs
    names = {parameter.replace('.', '_'): parameter for parameter in parameters} | renamed
    return tuple(Argument(name, specs[parameter]) for name, parameter in names.items())


LINK = arguments(
    driver.DriverSettings,
    'frame_id',
    'link.type',
    'link.port',
    'link.baud',
    'link.uri',
    'link.device',
    'link.channels',
    'link.recording',
)
"""Arguments of the link, and of the frame of its samples."""
STAGE = (
    *arguments(stage.StageSettings, 'stage.type'),
    *arguments(stage.BridgeSettings, *(spec.name for spec in specs_of(stage.BridgeSettings))),
)
"""Arguments of the stage."""
SPEED = arguments(driver.DriverSettings, speed='link.speed')  # Speed of a simulated sensor


def declared(name: str, default: str, description: str, *choices: str) -> DeclareLaunchArgument:
    """Declare an argument of a launch."""
    return DeclareLaunchArgument(
        name, default_value=default, description=description, choices=choices or None
    )


TRANSFORM = (
    declared(
        'base_frame',
        '',
        'frame of the robot, such as base_link, of which the static '
        'transform to frame_id is published; empty: none',
    ),
    declared('mounting_xyz_m', '0,0,0', 'place of the case in base_frame, m'),
    declared('mounting_rpy_rad', '0,0,0', 'roll, pitch and yaw of the case in base_frame, rad'),
)
"""Arguments of the static transform."""


def common_arguments(*own: Argument) -> list[DeclareLaunchArgument]:
    """Return the arguments that all launch files have."""
    return [
        declared(
            'params_file',
            str(parameter_file.nominal_path()),
            'parameter file of the sensor, its link and the nodes',
        ),
        declared('namespace', '', 'namespace of the nodes and their topics'),
        declared('log_level', 'info', 'log level', 'debug', 'info', 'warn', 'error', 'fatal'),
        declared(
            'enclave',
            '',
            'folder of the enclaves of SROS 2, such as /adxl_ros; each node '
            'has one of its name there; empty: none',
        ),
        *(argument.declared() for argument in own),
    ]


def describe(
    arguments: Sequence[DeclareLaunchArgument], make_nodes: Callable[[LaunchContext], list[Action]]
) -> LaunchDescription:
    """Describe a launch by its arguments and what makes its nodes."""
    names = [argument.name for argument in arguments]
    return LaunchDescription(
        [
            *arguments,
            OpaqueFunction(function=check_names, args=[names]),
            OpaqueFunction(function=make_nodes),
        ]
    )


def check_names(context: LaunchContext, names: Sequence[str]) -> None:
    """
    Refuse arguments that this launch does not have; `ros2 launch` ignores them.

    A launch file that includes this one has arguments of its own. What is like one of ours is
    then a warning.
    """
    path = context.get_locals_as_dict().get('current_launch_file_path')
    is_own = bool(path) and _is_on_command_line(path)
    for name in sorted(context.launch_configurations.keys() - {*names, _PUSHED}):
        near = get_close_matches(name, names, 1, 0.0 if is_own else _LIKENESS)
        text = f'{name}:=...: this launch has no such argument; did you mean {"".join(near)}?'
        if is_own:
            raise UserError(f'{text} --show-args lists all')
        if near:
            get_logger('launch.user').warning(text)


def _is_on_command_line(path: str) -> bool:
    """Return whether the command of this process names a launch file, by package or path."""
    return (_PACKAGE, Path(path).name) in pairwise(sys.argv) or Path(path).resolve() in [
        Path(word).resolve() for word in sys.argv
    ]


def make_node(
    context: LaunchContext,
    executable: str,
    overrides: Mapping[str, Any],
    params_file: str = '',
    respawn: bool = True,
    **options: Any,
) -> Node:
    """
    Make a node of this package with the parameter file of the launch.

    Without an `on_exit` of its own it is started again when it ends, unless `respawn` is false.
    """
    path = params_file or text(context, 'params_file')
    name = full_name(context, executable)
    is_named = has_section(path, name)
    if executable == 'driver' and not is_named:
        raise UserError(
            f'{path}: has no parameters of the node {name}; begin the file with /**: or {name}:'
        )
    link = [argument for argument in LINK if argument.name in context.launch_configurations]
    # launch_ros would read a text as YAML.
    given = {
        key: ParameterValue(value, value_type=str) if isinstance(value, str) else value
        for key, value in {**given_parameters(context, link), **overrides}.items()
    }
    options.setdefault('output', 'screen')
    if 'on_exit' not in options:
        options |= {'respawn': respawn, 'respawn_delay': 2.0, 'on_exit': end_with_refusal}
    # The nominal sensor is what a node without a file has; a file would name it for any stream.
    is_named &= path != str(parameter_file.nominal_path())
    given_files: list[Any] = [path] if is_named else []
    if given:
        given_files.append(given)
    # With its name a node gets the parameters in a section of its own, which counts before others.
    return Node(
        package=_PACKAGE,
        executable=executable,
        name=executable,
        namespace=text(context, 'namespace'),
        parameters=given_files,
        ros_arguments=[*_enclave(context, executable), '--log-level', text(context, 'log_level')],
        **options,
    )


def _enclave(context: LaunchContext, executable: str) -> list[str]:
    """Return the ROS arguments that put a node into its enclave of SROS 2."""
    folder = text(context, 'enclave')
    return ['--enclave', f'{folder.rstrip("/")}/{executable}'] if folder else []


def static_transform(context: LaunchContext) -> list[Action]:
    """Publish where the case is on the robot, if the launch names the frame of the robot."""
    base_frame = text(context, 'base_frame')
    executable = 'static_transform_publisher'
    if not base_frame:
        return []
    frame_id = given_anywhere(context, 'frame_id', 'driver') or driver.DEFAULT_FRAME
    values = (
        *three_numbers(context, 'mounting_xyz_m'),
        *three_numbers(context, 'mounting_rpy_rad'),
        base_frame,
        frame_id,
    )
    options = zip(
        ('--x', '--y', '--z', '--roll', '--pitch', '--yaw', '--frame-id', '--child-frame-id'),
        map(str, values),
    )
    return [
        Node(
            package='tf2_ros',
            executable=executable,
            ros_arguments=_enclave(context, executable),
            arguments=[*chain.from_iterable(options)],
        )
    ]


def three_numbers(context: LaunchContext, name: str) -> list[float]:
    """Return the three numbers of an argument."""
    given = text(context, name)
    try:
        x, y, z = _numbers(given)
    except ValueError:
        raise UserError(f'{name}:={given}: expected three numbers') from None
    return [x, y, z]


def text(context: LaunchContext, name: str) -> str:
    """Return the value of an argument."""
    return str(LaunchConfiguration(name).perform(context))


def given_parameters(context: LaunchContext, arguments: Sequence[Argument]) -> dict[str, Any]:
    """Return the parameters that the arguments of a launch give."""
    texts = {argument: text(context, argument.name) for argument in arguments}
    return {
        argument.spec.name: argument.value(given) for argument, given in texts.items() if given
    }


def full_name(context: LaunchContext, name: str) -> str:
    """Return the fully qualified name of a node or topic."""
    namespace = (
        prefix_namespace(context.launch_configurations.get(_PUSHED), text(context, 'namespace'))
        or ''
    )
    return '/'.join(('', *filter(None, namespace.split('/')), name))


def given_anywhere(context: LaunchContext, parameter: str, executable: str) -> str:
    """Return a parameter that an argument or the parameter file gives."""
    return text(context, parameter.replace('.', '_')) or given_text(
        text(context, 'params_file'), full_name(context, executable), parameter
    )


def simulated_link(context: LaunchContext, speed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a driver with a speed; a sensor without a link is simulated."""
    link = given_anywhere(context, 'link.type', 'driver')
    return {'link.type': link or 'sim', **speed} if speed else {}


def end_with_refusal(event: ProcessExited, context: LaunchContext) -> None:
    """End a launch when a node refuses to start: another start would be refused, too."""
    if not context.is_shutdown and event.returncode in _REFUSED_START:
        raise UserError(f'{event.process_name} has refused to start; its own line above says why')


def end_with(success: str, failure: str) -> Callable[[ProcessExited, LaunchContext], list[Action]]:
    """Return a function that ends a launch when its main node ends, with the same success."""

    def end(event: ProcessExited, context: LaunchContext) -> list[Action]:
        if context.is_shutdown:
            return []
        if event.returncode:
            raise UserError(
                f'{event.process_name} has ended with the status {event.returncode}; {failure}'
            )
        return [LogInfo(msg=success), Shutdown(reason=f'{event.process_name} is done')]

    return end


def refuse_simulated_stage(context: LaunchContext, others: str = '') -> None:
    """Refuse a stage that would be simulated beside a real sensor."""
    link = given_anywhere(context, 'link.type', 'driver')
    if link not in ('', 'sim') and not given_anywhere(context, 'stage.type', 'stage'):
        raise UserError(
            f'link_type is {link}, but the stage would be simulated; set stage_type:=trajectory '
            'or joint_state with bridge_alpha_joint and bridge_beta_joint for a stage that turns '
            f'itself, {others}or stage_type:=simulated'
        )
