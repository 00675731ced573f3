# SPDX-License-Identifier: Apache-2.0

"""The package that `colcon build` has installed, and the script `run`."""

from importlib.metadata import distribution, EntryPoint
import os
from pathlib import Path
import subprocess

from ament_index_python.packages import get_package_prefix, get_package_share_directory
from processes import executable, NEEDS_ROS2, PATIENCE, REPO
import pytest

SCRIPTS = [
    entry for entry in distribution('adxl_ros').entry_points if entry.group == 'console_scripts'
]
EXECUTABLES = [entry.name for entry in SCRIPTS]
LAUNCH_FILES = (
    'calibrate.launch.py',
    'emulate.launch.py',
    'investigate.launch.py',
    'robot.launch.py',
)


def run(*args: str, **options: object) -> subprocess.CompletedProcess:
    """Run the script `run` of this tree; skip if another build is under test."""
    if Path(get_package_prefix('adxl_ros')) != REPO / 'install' / 'adxl_ros':
        pytest.skip('the package under test was not built by make build')
    command = [options.pop('path', REPO / 'run'), *args]
    return subprocess.run(
        command, text=True, capture_output=True, timeout=60 * PATIENCE, **options
    )


@pytest.mark.parametrize('script', SCRIPTS, ids=EXECUTABLES)
def test_executable_is_where_ros2_run_looks(script: EntryPoint) -> None:
    assert os.access(executable(script.name), os.X_OK)
    assert callable(script.load())


@pytest.mark.parametrize(
    'path',
    [
        'package.xml',
        'params/adxl203.yaml',
        *(f'launch/{name}' for name in LAUNCH_FILES),
    ],
)
def test_share(path: str) -> None:
    assert (Path(get_package_share_directory('adxl_ros')) / path).is_file()


def test_run_lists_its_commands() -> None:
    for args in ((), ('no_such_tool',), ('../adxl_ros/fit',)):
        done = run(*args)
        assert done.returncode == 2
        assert done.stdout == ''
        assert done.stderr.count('\n') == 1
        assert all(name in done.stderr for name in EXECUTABLES)


@NEEDS_ROS2
@pytest.mark.parametrize('name', LAUNCH_FILES)
def test_launch_file_loads(name: str) -> None:
    from launch import LaunchContext
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    path = Path(get_package_share_directory('adxl_ros')) / 'launch' / name
    description = PythonLaunchDescriptionSource(str(path)).get_launch_description(LaunchContext())
    arguments = {argument.name for argument in description.get_launch_arguments()}
    assert arguments >= {'params_file', 'namespace', 'frame_id', 'log_level'}
