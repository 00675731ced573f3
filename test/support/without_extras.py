# SPDX-License-Identifier: Apache-2.0

"""A Python process in which the import of every extra fails, as without an installation."""

from importlib.metadata import requires
import json
import re
import subprocess
import sys

from processes import PATIENCE

# Packages with an import name that differs from the distribution, or without an entry in setup.py.
OTHERS = (
    'PIL',
    'arch',
    'iio',
    'jinja2',
    'mcap',
    'numba',
    'rosbag2_py',
    'ruamel',
    'serial',
    'sklearn',
    'tqdm',
)

BLOCK = """
import json, sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in blocked:
            raise ModuleNotFoundError(f'No module named {name!r}', name=name)

blocked = set(json.loads(sys.argv.pop(1)))
sys.meta_path.insert(0, Blocker())
"""


def extras() -> set[str]:
    """Return the names of the distributions that setup.py lists as extras."""
    lines = [line for line in requires('adxl_ros') or () if 'extra ==' in line]
    return {re.match(r'[\w.-]+', line)[0].replace('-', '_') for line in lines}


def run_without_extras(code: str, *args: str) -> subprocess.CompletedProcess:
    blocked = json.dumps(sorted(extras().union(OTHERS)))
    return subprocess.run(
        [sys.executable, '-c', BLOCK + code, blocked, *args],
        text=True,
        capture_output=True,
        timeout=60 * PATIENCE,
    )
