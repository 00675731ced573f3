# SPDX-License-Identifier: Apache-2.0

"""
The nodes and a fit of a CSV file need no extra beside rclpy, interfaces, numpy, scipy and PyYAML.

A subprocess in which the import of every extra fails stands for an environment without them.
"""

import json
from pathlib import Path
import re

from adxl_ros.errors import install_hint
import pytest
from without_extras import run_without_extras

IMPORT_ALL = """
from importlib import import_module
from importlib.util import find_spec
from pkgutil import walk_packages
import adxl_ros

wanted = sys.argv[1:]
modules = [m.name for m in walk_packages(adxl_ros.__path__, 'adxl_ros.')
           if m.name.split('.')[1] in wanted]
if not find_spec('launch'):
    # The wheels of ROS 2 have no ros2 launch, for which this module is.
    modules.remove('adxl_ros.nodes.launch_nodes')
for name in modules:
    import_module(name)
print(json.dumps({'modules': modules, 'blocked': sorted(blocked & set(sys.modules))}))
"""


def test_every_core_module_imports() -> None:
    wanted = ('errors', 'model', 'files', 'links', 'calibrate', 'nodes', 'tools')
    done = run_without_extras(IMPORT_ALL, *wanted)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert {name.split('.')[1] for name in result['modules']} == set(wanted)
    assert result['blocked'] == []


def test_what_needs_an_extra_names_the_package_to_install() -> None:
    code = """
import os
from adxl_ros.errors import UserError
from adxl_ros.files import bag_messages, parameter_file, tables
from adxl_ros.links import iio, serial
from adxl_ros.nodes.calibration_screen import open_screen
from adxl_ros.report import figures, page
sensor = parameter_file.load(parameter_file.nominal_path())
for use in (lambda: tables.open_table('log.ulg'), lambda: tables.open_table('log.parquet'),
            bag_messages.import_rosbags, figures.new_figure, page.check_libraries,
            lambda: serial.open_link(sensor, serial.Settings(port='/dev/null')),
            lambda: iio.open_link(sensor, iio.Settings())):
    try:
        use()
    except UserError as error:
        print(error)
sys.stdin.isatty = sys.stdout.isatty = lambda: True
os.tcgetpgrp = lambda fd: os.getpgrp()
open_screen('/calibration', print)
"""
    done = run_without_extras(code)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 8
    for line, name in zip(
        lines,
        (
            'pyulog',
            'pyarrow',
            'rosbags>=',
            'matplotlib',
            'plotly',
            'pyserial',
            "'pylibiio<1' and sudo apt install libiio0",
        ),
    ):
        assert re.search(f'install .*{re.escape(name)}', line), line
    # A calibration goes on.
    assert (
        lines[-1] == 'no screen, plain lines: it needs prompt_toolkit; pip install prompt_toolkit'
    )


@pytest.mark.long
def test_a_csv_is_fitted(tmp_path: Path) -> None:
    """`simulate` and `fit` on CSV need only numpy and scipy. A page names the missing package."""
    run = 'from adxl_ros.tools.{0} import main\nsys.argv[0] = {0!r}\nsys.exit(main())'
    sweep, output = str(tmp_path / 'sweep.csv'), str(tmp_path / 'unit.yaml')
    done = run_without_extras(run.format('simulate'), 'sweep', '--rate', '100', '-o', sweep)
    assert done.returncode == 0, done.stderr
    done = run_without_extras(run.format('fit'), sweep, '-o', output)
    assert done.returncode == 0, done.stderr
    assert Path(output).exists()
    done = run_without_extras(run.format('fit'), sweep, '-o', output, '--report', str(tmp_path))
    assert done.returncode == 1
    assert done.stderr == f'fit: pages need jinja2; {install_hint("plotly", "jinja2")}\n'
