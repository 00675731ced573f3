# SPDX-License-Identifier: Apache-2.0

"""The examples of the documentation run as they are."""

from pathlib import Path
import subprocess
import sys

from processes import PATIENCE, REPO
import pytest

pytestmark = pytest.mark.long
FILES = {
    'allan_of_a_log': ['allan.png', 'noise.yaml'],
    'calibrate_arrays': ['unit.yaml'],
    'log_against_mujoco': ['gap.png'],
    'stage_sweep': ['report', 'unit.yaml'],
    'thousand_sensors': [],
    'tilt_with_covariance': [],
}
"""What each example writes into the folder that it is started in."""


@pytest.mark.parametrize('name', FILES)
def test_an_example_runs_and_writes(name: str, tmp_path: Path) -> None:
    if name == 'log_against_mujoco':
        pytest.importorskip('mujoco', reason='mujoco is not installed: pip install mujoco')
    done = subprocess.run(
        [sys.executable, REPO / 'docs' / 'examples' / f'{name}.py'],
        text=True,
        capture_output=True,
        cwd=tmp_path,
        timeout=60 * PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == '' and done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == FILES[name]
