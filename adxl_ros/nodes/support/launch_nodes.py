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

"""What the launch files share: arguments, the parameter file of each node, failed starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.nodes.support.params_files import has_section
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.events.process import ProcessExited
from launch.launch_context import LaunchContext
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

_LINK = {
    'link_type': 'link of the driver: serial, iio, replay, or sim for a simulated sensor',
    'link_port': 'serial: device path, such as /dev/ttyACM0, or a pyserial URL',
    'link_baud': 'serial: baud rate of a UART',
    'link_uri': 'iio: URI of libiio, such as local: or ip:HOST',
    'link_device': 'iio: name, id or label of the ADC',
    'link_channels': 'serial and iio: roles of the channels, with commas',
    'link_recording': 'replay: the recording to play',
}
"""Arguments of the link; each is the parameter of the driver with a dot for the first _."""
_WHOLE_NUMBERS = ('link_baud',)
"""Arguments that are whole numbers; the others are texts."""
_REFUSED_START = (1, 2)
"""Exit statuses of a node that does not start; a signal ends it with 0 or a negative one."""
_MOST_REFUSALS = 3
"""Failed starts of a node after which a launch ends; chosen: a device may come late once."""


def common_arguments() -> list[DeclareLaunchArgument]:
    """Return the arguments that all launch files have."""
    texts = {
        'namespace': ('', 'namespace of the nodes and their topics'),
        'frame_id': ('imu_link', 'frame of the case'),
        'log_level': ('info', 'log level: debug, info, warn, error or fatal'),
        **{name: ('', f'{text}; empty: as in params_file') for name, text in _LINK.items()}}
    return [
        DeclareLaunchArgument('params_file', default_value=str(parameter_file.nominal_path()),
                              description='parameter file of the sensor, its link and the nodes'),
        *(DeclareLaunchArgument(name, default_value=default, description=text)
          for name, (default, text) in texts.items())]


def make_node(context: LaunchContext, executable: str, overrides: Mapping[str, Any],
              **options: Any) -> Node:
    """
    Make a node of this package with the parameter file of the launch.

    Parameters
    ----------
    context
        The launch, which has the arguments.
    executable
        Its executable, which is its name, too.
    overrides
        Parameters in place of those of the file.
    options
        Further options of the action.

    Returns
    -------
    Node
        The action.

    Raises
    ------
    UserError
        The parameter file cannot be read, or it names other nodes than the driver.

    """
    path, namespace = argument(context, 'params_file'), argument(context, 'namespace')
    name = '/'.join(('', *filter(None, namespace.split('/')), executable))
    is_named = has_section(path, name)
    if executable == 'driver' and not is_named:
        raise UserError(f'{path}: has no parameters of the node {name}; begin the file with /**: '
                        f'or {name}:')
    shared = {'frame_id': text(argument(context, 'frame_id')), **_link(context)}
    return Node(package='adxl_ros', executable=executable, namespace=namespace, output='screen',
                parameters=[*([path] if is_named else []), {**shared, **overrides}],
                ros_arguments=['--log-level', argument(context, 'log_level')], **options)


def argument(context: LaunchContext, name: str) -> str:
    """
    Return the value of an argument.

    Parameters
    ----------
    context
        The launch.
    name
        Name of the argument.

    Returns
    -------
    str
        Its value.

    """
    return str(LaunchConfiguration(name).perform(context))


def text(value: str) -> ParameterValue:
    """Return a string as a parameter, also where it looks like a number."""
    return ParameterValue(value, value_type=str)


def _link(context: LaunchContext) -> dict[str, ParameterValue]:
    """Return the parameters of the link that the arguments give."""
    given = {name: argument(context, name) for name in _LINK}
    return {name.replace('_', '.', 1): ParameterValue(
        value, value_type=int if name in _WHOLE_NUMBERS else str)
        for name, value in given.items() if value}


class GiveUp:
    """Ends a launch when a node that is started again and again refuses to start."""

    def __init__(self) -> None:
        self._refusals = 0

    def __call__(self, event: ProcessExited, context: LaunchContext) -> Shutdown | None:
        """
        Count the refused starts of a node.

        Parameters
        ----------
        event
            The end of its process.
        context
            The launch.

        Returns
        -------
        Shutdown
            The end of the launch, or None while it goes on.

        """
        self._refusals += event.returncode in _REFUSED_START
        if self._refusals < _MOST_REFUSALS:
            return None
        return Shutdown(reason=f'{event.process_name} has refused to start {self._refusals} times')
