# SPDX-License-Identifier: Apache-2.0


"""Errors of a reference that is another instrument: the verdict names it, not the sensor."""

from dataclasses import replace
import json

from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.simulate.motion import ForcePath, Motion
from adxl_ros.simulate.response import Response
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, sosfilt, sosfiltfilt
from scipy.spatial.transform import Rotation
from units import nominal, with_effects

pytestmark = pytest.mark.long

G = 9.80665
FINE_HZ = 1000.0
RATE_HZ = 125.0
SECONDS = 65.0


def carried_by_hand(seed, tremor_g):
    """Return times, s, and the force on a sensor that rests, and then is moved by hand, (n, 3)."""
    rng, time_s = np.random.default_rng(seed), np.arange(SECONDS * FINE_HZ) / FINE_HZ

    def band(low_hz, high_hz, rms):
        sections = butter(2, [low_hz, high_hz], 'band', fs=FINE_HZ, output='sos')
        values = sosfiltfilt(sections, rng.standard_normal(len(time_s)))
        return values * rms / values.std()

    begins = np.clip(time_s - 8.0, 0.0, 1.0)
    begins = begins**2 * (3 - 2 * begins)
    roll, pitch = band(0.05, 0.4, 0.5) * begins, band(0.05, 0.4, 0.4) * begins
    gravity = G * np.column_stack(
        [-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)]
    )
    motion = [band(0.3, 3.0, 0.08 * G) + band(3.0, 12.0, tremor_g * G) for _ in range(3)]
    return time_s, gravity + np.column_stack(motion) * begins[:, None]


def gaussian(force):
    """Smooth with a kernel of 25 ms."""
    return gaussian_filter1d(force, 0.025 * FINE_HZ, axis=0)


def causal(force):
    """Filter while recording, as a tracker does that shows its poses live."""
    sections = butter(2, 8.0, fs=FINE_HZ, output='sos')
    return sosfilt(sections, force - force[0], axis=0) + force[0]


@pytest.fixture
def diagnosed(run_tool, tmp_path):
    """Give a function that diagnoses a simulated recording beside a reference; its report."""

    def diagnose(
        effects=(),
        smooth=None,
        late_s=0.0,
        turn_rad=(0.0, 0.0, 0.0),
        rate_hz=RATE_HZ,
        tremor_g=0.02,
    ):
        sensor = replace(nominal('xyz'), rate_hz=RATE_HZ)
        time_s, force = carried_by_hand(3, tremor_g)
        stamps_s = np.arange((SECONDS - 1) * RATE_HZ) / RATE_HZ
        respond = Response(
            with_effects(sensor, list(effects)), Motion(SECONDS, force=ForcePath(time_s, force)), 5
        )
        volts = respond(stamps_s)
        stated = (
            Rotation.from_euler('xyz', turn_rad).inv().apply(smooth(force) if smooth else force)
        )
        every = round(FINE_HZ / rate_hz)
        np.savetxt(
            tmp_path / 'sim.csv',
            np.column_stack([time_s + late_s, stated])[::every],
            '%.9g',
            ',',
            comments='',
            header='time_s,ax_mps2,ay_mps2,az_mps2',
        )
        columns = {f'{axis}_v': v for axis, v in zip('xyz', volts.T)}
        return report(sensor, stamps_s, columns, ['--sim', 'sim.csv'])

    def report(sensor, time_s, columns, options):
        parameter_file.save(tmp_path / 'unit.yaml', sensor, [])
        with recording.writer(tmp_path / 'run.csv', sensor) as write:
            write(Recording('run.csv', time_s, columns, sensor_info(sensor)))
        run = run_tool('diagnose', 'run.csv', '--params', 'unit.yaml', *options, '-o', 'gap')
        assert run.returncode == 0, run.stderr
        screens.append(run.stdout)
        return json.loads((tmp_path / 'gap' / 'report.json').read_text())

    screens = []
    diagnose.report, diagnose.screens = report, screens
    return diagnose


@pytest.mark.parametrize('smooth', [gaussian, causal])
def test_a_smoothed_reference_is_named(run_tool, diagnosed, tmp_path, smooth):
    """
    A filter is named; screen, page and report say that it is the reference.

    Parameters with errors of a reference simulate a manoeuvre without them.
    """
    answer = diagnosed(smooth=smooth)
    verdict = answer['verdict']
    assert verdict['status'] in ('explained', 'partly')
    assert verdict['effects'] == ['reference_filter']
    assert verdict['of'] == 'reference'
    assert answer['gap']['closed'] > 0.3
    assert answer['gap']['not_in_reference'] > 0
    assert 'less smoothing' in answer['next_experiment']['manoeuvre']
    assert answer['next_experiment']['command'] in ' '.join(
        diagnosed.screens[0].replace('\\\n', ' ').split()
    )
    sentence = 'rror of the reference, not of the sensor'
    assert sentence in answer['summary']
    assert sentence in ' '.join(diagnosed.screens[0].split())
    assert sentence in (tmp_path / 'gap' / 'report.html').read_text()
    run = run_tool(
        'simulate', 'sweep', '--params', 'gap/params.yaml', '--rate', '20', '-o', 'sweep.csv'
    )
    assert run.returncode == 0
    assert 'reference_filter is an error of the reference' in run.stderr


def test_a_turned_frame_is_not_separated_from_turned_axes(diagnosed):
    """A turn of the frame gives the same samples as an equal turn of all sensing axes."""
    answer = diagnosed(turn_rad=(0.02, -0.01, 0.03))
    assert answer['verdict']['groups'] == [['misalignment', 'reference_frame']]
    turn = (
        answer['candidates'][0]
        if answer['candidates'][0]['effect'] == 'reference_frame'
        else answer['candidates'][1]
    )
    assert [turn['parameters'][f'{axis}_rad']['value'] for axis in 'xyz'] == pytest.approx(
        [0.02, -0.01, 0.03], abs=1e-3
    )


def test_a_simulation_with_an_error_of_the_reference_alone_is_refused(run_tool, tmp_path):
    refused = run_tool('simulate', 'sweep', '--effect', 'reference_filter', '-o', 'no.csv')
    assert refused.returncode == 1
    assert len(refused.stderr.splitlines()) == 1
    assert not (tmp_path / 'no.csv').exists()
