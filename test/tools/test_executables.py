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

"""The installed executables of the tools: exit status, stdout and stderr."""

import os
import subprocess
import sys

from processes import executable, run_executable
import pytest

TOOLS = ('apply', 'blind', 'check', 'diagnose', 'fit', 'noise', 'reproduce', 'simulate', 'working')


@pytest.mark.parametrize('name', TOOLS)
def test_help_and_wrong_usage(name: str) -> None:
    described = run_executable(name, '--help')
    assert (described.returncode, described.stderr) == (0, '')
    assert described.stdout.startswith(f'usage: {name}')
    refused = run_executable(name, '--no-such-option')
    assert (refused.returncode, refused.stdout) == (2, '')
    assert refused.stderr.startswith(f'usage: {name}')


@pytest.mark.parametrize('name', ['apply', 'diagnose', 'fit'])
def test_a_recording_that_is_missing_is_one_line_and_status_1(name: str, tmp_path) -> None:
    refused = run_executable(name, 'missing.csv', '-o', 'out', cwd=tmp_path)
    assert (refused.returncode, refused.stdout) == (1, '')
    assert refused.stderr.startswith(f'{name}: missing.csv')
    assert refused.stderr.count('\n') == 1
    assert not list(tmp_path.iterdir())


def test_a_recording_is_simulated_and_fitted(tmp_path) -> None:
    simulated = run_executable('simulate', 'sweep', '--rate', '50', '-o', 'sweep.csv',
                               cwd=tmp_path)
    assert simulated.returncode == 0
    fitted = run_executable('fit', 'sweep.csv', '-o', 'unit.yaml', '--store', '', cwd=tmp_path)
    assert fitted.returncode == 0
    assert 'full model' in fitted.stdout
    assert '#   scale factor ' in (tmp_path / 'unit.yaml').read_text()


def test_a_reader_that_closes_the_pipe_causes_no_traceback(tmp_path) -> None:
    code = f'{executable("simulate")} --help | {sys.executable} -c pass'
    piped = subprocess.run(['sh', '-c', code], text=True, capture_output=True, cwd=tmp_path,
                           env=os.environ, timeout=60)
    assert piped.stderr == ''
