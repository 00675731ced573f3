# SPDX-License-Identifier: Apache-2.0

"""What the diagnosis reports: the gap and its parts, and what it does not determine."""

from html import escape
import json
import re

from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.report.quantities import parameter_text
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import simulate
import numpy as np
import pytest
from units import nominal, with_effects

pytestmark = pytest.mark.long


def unit(**changes):
    return nominal('xy', rate_hz=62.5, stage_resolution_rad=1e-4, **changes)


def turning(alphas_rad=(np.pi / 2, np.pi / 4)):
    script = trajectories.Script(alphas_rad[0], 0.0)
    for alpha in alphas_rad:
        script.go(alpha, 0.0)
        for speed in (0.6, 1.6):
            for to in (2.5, 0.0):
                script.rest(2.0)
                script.run('beta', to, speed)
    script.rest(2.0)
    return Motion(script.now_s, *script.joints())


class Report:
    """What `diagnose` reports: `json`, text of `terminal` and `page`, and the `sensor`."""

    def __init__(self, run_tool, folder, sensor, *effects, motion=None, params=None, change=None):
        columns = simulate(with_effects(sensor, list(effects)), motion or turning(), 3)
        if change is not None:
            columns = change(columns)
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
        return next(c for c in self.json['candidates'] if c['effect'] == effect)['parameters']


@pytest.fixture
def diagnosed(run_tool, tmp_path):
    """Give a function that records and diagnoses, with the arguments of `Report`."""
    return lambda *args, **keys: Report(run_tool, tmp_path, *args, **keys)


def test_the_gap_is_recording_minus_simulation(diagnosed):
    """A zero-g that moved by 3 mg is in the gap beyond what a healthy unit moves by, 0.3 mg."""
    moved_v = {'x_v': 3e-3, 'y_v': -3e-3}
    report = diagnosed(
        unit(),
        change=lambda columns: columns | {name: columns[name] + v for name, v in moved_v.items()},
    )
    gap, mg = report.json['gap'], G0_MPS2 / 1e3
    floor_mg = gap['floor'] / mg
    assert gap['before'] / mg == pytest.approx(np.hypot(2.7, floor_mg), rel=0.03)


def test_a_line_that_stays_is_shown_and_not_called_closed(diagnosed):
    """Beside another scale factor, hum stays in recording minus simulation."""

    def change(columns):
        time_s = columns['time_s']
        hum_v = 2e-3 * np.sin(2 * np.pi * 50.01 * time_s + 1)
        return columns | {name: columns[name] + hum_v for name in ('x_v', 'y_v')}

    report = diagnosed(unit(), 'scale_factor:offset_v_per_g=0.01', change=change)
    assert 'mains_hum' in report.json['verdict']['effects']
    (line,) = report.json['noise_remainders']
    mg = G0_MPS2 / 1e3
    assert line['recorded'] / mg == pytest.approx(2.0, rel=0.05)
    assert line['simulated'] / mg == pytest.approx(2.0, rel=0.05)
    assert line['left'] / mg < 0.1
    gap = report.json['gap']
    # The line is above the floor, and stays: half of the square of its amplitude.
    assert gap['after'] ** 2 - gap['floor'] ** 2 > 1.8 * mg**2
    assert '100 %' not in report.terminal
    assert '2.0' in next(row for row in report.terminal.splitlines() if 'line at 50.0' in row)


def test_terminal_page_and_report_agree(diagnosed):
    report = diagnosed(unit(), 'scale_factor:offset_v_per_g=0.01')
    gap, mg = report.json['gap'], G0_MPS2 / 1e3
    assert gap['closed'] == pytest.approx(
        (gap['before'] ** 2 - gap['after'] ** 2) / (gap['before'] ** 2 - gap['floor'] ** 2),
        abs=0.01,
    )
    for key in ('before', 'after', 'floor'):
        text = f'{gap[key] / mg:.2f} mg'
        figure = text if gap[key] == 0 or gap[key] / mg >= 0.005 else '< 0.01 mg'
        assert figure in report.terminal
        assert escape(figure) in report.page and figure in report.json['summary']
    assert max(map(len, report.terminal.splitlines())) < 80 and '\x1b' not in report.terminal
    assert f'{gap["before"] / mg:.2f} mg -> {gap["after"] / mg:.2f} mg rms' in report.terminal
    shares = re.findall(r'(\d+) %$', report.terminal, re.MULTILINE)
    assert sum(map(int, shares)) == pytest.approx(100 * gap['closed'], abs=1)
    # The command may take two lines of a shell.
    assert report.json['next_experiment']['command'] in ' '.join(
        report.terminal.replace('\\\n', ' ').split()
    )


@pytest.mark.parametrize(
    'value, ci, unit_name, text',
    [
        (3.9e-4, [3.47e-4, 4.33e-4], 'g/K', '0.39 (0.35 to 0.43) mg/K'),
        (0.0298, [0.0294, 0.0302], 'm', '29.8 (29.4 to 30.2) mm'),
        (2e-6, [1e-6, 3e-6], 'g/K^2', '2.0 (1.0 to 3.0) µg/K²'),
        (43.0, [38.0, 48.0], 's', '43 (38 to 48) s'),
        (0.0040, [0.0039, 0.0041], 'rad', '0.229 (0.223 to 0.235) deg'),
        (2e-3, [1e-3, 3e-3], 'V', '2.0 (1.0 to 3.0) mg'),
        (0.3, [0.2, 0.4], '1', '0.30 (0.20 to 0.40)'),
    ],
)
def test_parameters_have_a_prefix_and_few_digits(value, ci, unit_name, text):
    """A value has the digits that its interval allows; volts are shown as acceleration."""
    assert parameter_text({'value': value, 'ci': ci, 'unit': unit_name}) == text
