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

"""What the diagnosis reports: the gap and its parts, and what it does not determine."""

import json

from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.simulator import simulate
from adxl_ros.tools.effect_option import with_effects
import numpy as np
import pytest
from units import nominal

pytestmark = pytest.mark.long


def unit(**changes):
    """Return a nominal unit of two axes at 62.5 Hz, with a fine encoder."""
    return nominal('xy', rate_hz=62.5, stage_resolution_rad=1e-4, **changes)


def turning(alphas_rad=(np.pi / 2, np.pi / 4)):
    """Turn beta forth and back at two speeds in each plane, with rests."""
    script = trajectories.Script(alphas_rad[0], 0.0)
    for alpha in alphas_rad:
        script.go(alpha, 0.0)
        for speed in (0.6, 1.6):
            for to in (2.5, 0.0):
                script.rest(2.0)
                script.run('beta', to, speed)
    script.rest(2.0)
    return Motion(script.now, *script.joints())


class Report:
    """What `diagnose` says of a simulated recording: report, terminal, page and parameters."""

    def __init__(self, run_tool, folder, sensor, *effects, motion=None, params=None, change=None):
        columns = simulate(with_effects(sensor, list(effects)), motion or turning(), 3)
        if change is not None:
            columns = change(columns)
        self.columns = dict(columns)
        recorded = Recording('made', columns.pop('time_s'), columns, sensor_info(sensor))
        recording.write(folder / 'run.csv', recorded, sensor)
        parameter_file.save(folder / 'unit.yaml', params or sensor)
        run = run_tool('diagnose', 'run.csv', '--params', 'unit.yaml', '-o', 'out')
        assert (run.returncode, run.stderr) == (0, '')
        self.terminal = run.stdout
        self.json = json.loads((folder / 'out' / 'report.json').read_text())
        self.page = (folder / 'out' / 'report.html').read_text()
        self.sensor = parameter_file.load(folder / 'out' / 'params.yaml')

    def parameters(self, effect):
        """Return the parameters of a candidate."""
        return next(c for c in self.json['candidates'] if c['effect'] == effect)['parameters']


@pytest.fixture
def diagnosed(run_tool, tmp_path):
    """Give a function that records and diagnoses, with the arguments of `Report`."""
    return lambda *args, **keys: Report(run_tool, tmp_path, *args, **keys)


def test_the_gap_is_recording_minus_simulation(diagnosed):
    """A zero-g that moved by 3 mg is in the gap, and stands beside it."""
    moved_v = {'x_v': 3e-3, 'y_v': -3e-3}
    report = diagnosed(unit(), change=lambda columns: columns | {
        name: columns[name] + v for name, v in moved_v.items()})
    gap, mg = report.json['gap'], G0_MPS2 / 1e3
    floor_mg = gap['floor'] / mg
    assert gap['before'] / mg == pytest.approx(np.hypot(3.0, floor_mg), rel=0.02)
    assert gap['zero_g'] / mg == pytest.approx(3.0, rel=0.02)
    assert gap['drift'] < 0.1 * gap['zero_g']
    assert gap['closed'] == pytest.approx(
        (gap['before'] ** 2 - gap['after'] ** 2) / (gap['before'] ** 2 - gap['floor'] ** 2),
        abs=0.01)


@pytest.mark.parametrize('filed', [
    [], ['stage_offset:alpha_rad=0.02', 'misalignment:alpha_rad=0.1']])
def test_one_alpha_does_not_determine_a_tilt_of_the_axes(diagnosed, filed):
    """With alpha held, the axes' tilt out of the plane is a straight line at most."""
    sensor = unit()
    report = diagnosed(sensor, 'misalignment:alpha_rad=0.01,beta_rad=0.004',
                       motion=turning([np.pi / 2] * 2), params=with_effects(sensor, filed))
    parameters = report.parameters('misalignment')
    for axis in 'xy':
        assert parameters[f'alpha_rad.{axis}'] == {
            'value': None, 'ci': None, 'unit': 'rad', 'determined': False,
            'not_separated_from': []}
    assert parameters['beta_rad.x']['determined']
    # What is not determined stays as it was, because the file may serve other recordings.
    filed_rad = 0.1 if filed else 0.0
    values = report.sensor.values.get('misalignment', {'alpha_rad': [filed_rad] * 2})
    assert list(values['alpha_rad']) == [filed_rad] * 2


def test_two_planes_determine_a_tilt_of_the_axes(diagnosed):
    """A second plane determines what one alpha does not."""
    report = diagnosed(unit(), 'misalignment:alpha_rad=0.01,beta_rad=0.004')
    low, high = report.parameters('misalignment')['alpha_rad.x']['ci']
    assert low < 0.01 < high
