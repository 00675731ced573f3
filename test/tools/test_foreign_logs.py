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

"""Logs of other software, from the file as it came to a calibrated parameter file."""

from pathlib import Path
import shlex

from adxl_ros.files import parameter_file
from foreign_logs import BIAS_G, FORMS, SCALE, turned
import numpy as np
import pytest


def written(folder: Path, name: str, text: str | bytes) -> str:
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return name


def proposed(error: str) -> list[str]:
    """Return the options that a message proposes, as a shell reads them."""
    assert error.count('\n') == 1, error
    return shlex.split(error[error.index('--columns'):].replace('--rate HZ', '--rate 100'))


def check_errors(path: Path, atol_g: float = 2e-3) -> None:
    """Compare a calibration with the errors of the sensor."""
    fitted = parameter_file.load(path)
    scale = fitted.nominal_scale_v_per_g
    np.testing.assert_allclose((fitted.zero_g_v - fitted.nominal_zero_g_v) / scale, BIAS_G,
                               atol=atol_g)
    np.testing.assert_allclose(fitted.scale_v_per_g / scale, SCALE, atol=2e-3)


@pytest.mark.parametrize('name', FORMS)
def test_two_commands_from_a_log_to_a_calibration(run_tool, tmp_path, name) -> None:
    """The first answer proposes the columns and writes nothing; with them `fit` calibrates."""
    written(tmp_path, name, FORMS[name](turned()))
    done = run_tool('fit', name, '-o', 'unit.yaml')
    assert done.returncode == 1 and not (tmp_path / 'unit.yaml').exists()
    done = run_tool('fit', name, '-o', 'unit.yaml', *proposed(done.stderr))
    assert done.returncode == 0, done.stderr
    check_errors(tmp_path / 'unit.yaml')
