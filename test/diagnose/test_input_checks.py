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

"""What is wrong with the input of a diagnosis is named before any effect."""

from dataclasses import replace
import json

from adxl_ros.diagnose import data_checks
from adxl_ros.diagnose.baseline_comparison import compare
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.simulator import simulate
import numpy as np
from units import nominal


def unit(rate_hz=100.0):
    """Return a nominal unit on a stage with a fine encoder."""
    return replace(nominal('xyz'), rate_hz=rate_hz, stage_resolution_rad=1e-4)


def script(turns=3):
    """Turn beta in several planes, with rests."""
    path = trajectories.Script(np.pi / 2, 0.0)
    for alpha in (np.pi / 2, 1.0, 2.2)[:turns]:
        path.go(alpha, 0.0)
        for to, speed in ((2.0, 0.6), (0.5, 1.5), (4.0, 1.0), (0.0, 0.8)):
            path.run('beta', to, speed)
            path.rest(1.0)
    return path


def made(sensor, turns=3, seed=3):
    """Simulate a recording."""
    path = script(turns)
    columns = simulate(sensor, Motion(path.now, *path.joints()), seed)
    return Recording('made', columns.pop('time_s'), columns, sensor_info(sensor))


def report_of(run_tool, tmp_path, sensor, *recordings, options=()):
    """Run `diagnose` on recordings; return its report and the process."""
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    names = [f'run{i}.csv' for i in range(len(recordings))]
    for name, recorded in zip(names, recordings):
        recording.write(tmp_path / name, recorded, sensor)
    run = run_tool('diagnose', *names, '--params', 'unit.yaml', '-o', 'out', '--json', *options)
    return json.loads(run.stdout), run


def test_no_verdict_is_exit_status_1(run_tool, tmp_path):
    """A fault of the recording ends with 1, a complete report, and one line on stderr."""
    recorded = made(unit())
    recorded.columns['y_v'] = 5 - recorded.columns['y_v']
    report, run = report_of(run_tool, tmp_path, unit(), recorded)
    assert run.returncode == 1
    assert run.stderr.count('\n') == 1
    assert 'run0.csv: no verdict (axis_inverted)' in run.stderr
    assert report['verdict']['status'] == 'bad_data'
    assert 'Exit status' in run_tool('diagnose', '--help').stdout


def test_short_recordings_count_together():
    """Two recordings of 20 s are long enough, one is not."""
    recorded = made(unit(), turns=1)
    comparison = compare(recorded, unit())
    assert 15 < comparison.span_s < data_checks.SHORTEST_S
    assert data_checks.find_length_fault([comparison]).status == 'insufficient'
    assert data_checks.find_length_fault([comparison, comparison]) is None
    assert data_checks.find_data_fault(comparison, comparison) is None
