# SPDX-License-Identifier: Apache-2.0

"""
The nodes and a fit of a CSV file need no extra beside rclpy, interfaces, numpy, scipy and PyYAML.

A subprocess in which the import of every extra fails stands for an environment without them.
"""

import json
from pathlib import Path
import re

from adxl_ros.errors import install_hint
from processes import REPO
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


def test_a_link_without_its_extra_names_the_package_to_install() -> None:
    code = """
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.links.support import base
for name, settings in (('serial', {'port': '/dev/null'}), ('iio', {})):
    module = base.link_module(name)
    try:
        module.open_link(parameter_file.load(sys.argv[1]), module.Settings(**settings))
    except UserError as error:
        print(error)
"""
    nominal = REPO / 'params' / 'adxl203.yaml'
    done = run_without_extras(code, str(nominal))
    assert done.returncode == 0, done.stderr
    serial, iio = done.stdout.splitlines()
    assert 'pip install pyserial' in serial
    assert "pip install 'pylibiio<1' and sudo apt install libiio0" in iio


def test_what_needs_an_extra_names_it() -> None:
    code = """
from adxl_ros.errors import UserError
from adxl_ros.files import bag_messages, tables
from adxl_ros.report import figures, page
for use in (lambda: tables.open_table('log.ulg'), lambda: tables.open_table('log.parquet'),
            bag_messages.import_rosbags, figures.pyplot, page.check_libraries):
    try:
        use()
    except UserError as error:
        print(error)
"""
    lines = run_without_extras(code).stdout.splitlines()
    assert len(lines) == 5
    for line, name in zip(lines, ('pyulog', 'pyarrow', 'rosbags>=', 'matplotlib', 'plotly')):
        assert re.search(f'install .*{re.escape(name)}', line), line


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
