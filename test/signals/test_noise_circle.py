# SPDX-License-Identifier: Apache-2.0

"""What `noise` measures is what its file simulates, and what each export of it states."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import re

from adxl_ros.errors import UserError
from adxl_ros.files import exports, parameter_file
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor, to_nominal_mps2, with_axes
from adxl_ros.signals.noise_parameters import recording_noise, RecordingNoise, with_noise
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import simulate
import numpy as np
from processes import REPO
import pytest

SENSORS = sorted(path.stem for path in (REPO / 'params').glob('*.yaml') if path.stem != 'any_imu')
RATES_HZ = (50.0, 200.0, 1000.0)
SECONDS = 11.0


def one_axis(name: str) -> Sensor:
    return with_axes(parameter_file.load(name), 'x')


FEWEST_CHANGES = 10
"""Changes of the reading below which the noise is lost in the steps of the ADC."""


def at_rest(sensor: Sensor, seed: int, seconds: float = SECONDS) -> Recording:
    columns = simulate(sensor, Motion(seconds), seed)
    return Recording('still.csv', columns['time_s'], {'x_v': columns['x_v']}, sensor_info(sensor))


def sample_std(recording: Recording, sensor: Sensor) -> float:
    """Return the standard deviation of a sample, m/s²."""
    return float(to_nominal_mps2(recording.columns['x_v'][:, None], sensor).std())


def measured(recording: Recording, stated: Sensor, folder: Path) -> tuple[Sensor, RecordingNoise]:
    """Return the sensor that `noise` writes, and its result."""
    parameter_file.save(folder / 'stated.yaml', stated)
    result = recording_noise(lambda: [recording], str(folder / 'stated.yaml'))
    at_rate = replace(stated, rate_hz=round(result.rest.rate_hz, 6))
    return with_noise(at_rate, result.axes, result.rest), result


@pytest.mark.parametrize('rate_hz', RATES_HZ)
@pytest.mark.parametrize('name', SENSORS)
def test_the_file_simulates_the_recording(name: str, rate_hz: float, tmp_path: Path) -> None:
    true = replace(one_axis(name), rate_hz=rate_hz)
    recorded = at_rest(true, 1)
    if np.count_nonzero(np.diff(recorded.columns['x_v'])) < FEWEST_CHANGES:
        with pytest.raises(UserError, match='never changes'):
            measured(recorded, one_axis(name), tmp_path)
        return
    sensor, result = measured(recorded, one_axis(name), tmp_path)
    again = at_rest(sensor, 2)
    # The deviation of 11 s behind the slowest filter, 15 Hz, is known within 5 %.
    assert sample_std(again, sensor) == pytest.approx(sample_std(recorded, true), rel=0.15)
    if result.axes[0].fit.white.is_seen:
        variance = noise.density_v2_per_hz(sensor, np.zeros(1))[0, 0]
        expected = noise.density_v2_per_hz(true, np.zeros(1))[0, 0]
        # N of 550 samples is known within 15 %, and of 30 logs one is twice as far off.
        assert np.sqrt(variance / expected) == pytest.approx(1.0, rel=0.3)
    else:
        assert sensor.noise_density_g_per_rthz <= true.noise_density_g_per_rthz


@pytest.mark.parametrize('name', ['adxl355', 'mpu6050'])
def test_noise_that_refutes_the_stated_filter(name: str, tmp_path: Path) -> None:
    """A slow host drops samples of a fast filter, so that all of its noise aliases."""
    aliased = replace(one_axis(name), rate_hz=100.0, filter_rate_hz=0.0)
    recorded = at_rest(aliased, 1)
    sensor, _ = measured(recorded, one_axis(name), tmp_path)
    assert sample_std(at_rest(sensor, 2), sensor) == pytest.approx(
        sample_std(recorded, aliased), rel=0.1
    )


@pytest.mark.parametrize('amplitude_mg', [0.3, 2.0])
def test_mains_do_not_change_an_analog_filter_much(amplitude_mg: float, tmp_path: Path) -> None:
    sensor = one_axis('adxl203')
    recorded = at_rest(sensor, 1)
    recorded.columns['x_v'] += amplitude_mg * 1e-3 * np.sin(2 * np.pi * 50 * recorded.time_s)
    found, _ = measured(recorded, sensor, tmp_path)
    assert found.rc_s == pytest.approx(sensor.rc_s, rel=0.3)
    assert noise.analog_std_v(found) == pytest.approx(noise.analog_std_v(sensor), rel=0.3)


def figures(text: str, pattern: str) -> list[float]:
    """Return the numbers of the first match of a pattern."""
    found = re.search(pattern, text)
    assert found
    return [float(number) for number in re.findall(r'-?\d[\d.e+-]*', found[1])]


Figure = Callable[[RecordingNoise, float], float]  # Of the result and the deviation, m/s²


def a_deviation(_: RecordingNoise, std_mps2: float) -> float:
    return std_mps2


def a_variance(_: RecordingNoise, std_mps2: float) -> float:
    return std_mps2**2


def a_density(result: RecordingNoise, _: float) -> float:
    return result.axes[0].sample_white


FIGURES: dict[str, tuple[str, Figure]] = {
    'broadcaster': (r'linear_acceleration: \[([^,]*),', a_variance),
    'fusioncore': (r'accel_noise: (\S*)', a_deviation),
    'json': (r'"sample_variance": (\S*),', a_variance),
    'kalibr': (r'noise_density: (\S*)', a_density),
    'okvis2': (r'sigma_a_c: (\S*)', a_density),
    'point_lio': (r'imu_meas_acc_cov: (\S*)', a_variance),
    'genesis': (r"'acc_noise': \(([^,]*),", a_deviation),
    'isaaclab': (r'std=torch.tensor\(\(([^,]*),', a_deviation),
    'mjlab': (r'std=\(([^,]*),', a_deviation),
    'mujoco': (r'noise="([^"]*)"', a_deviation),
    'sdf': (r'<stddev>(.*)</stddev>', a_deviation),
}
"""Where a format states its figure of the noise, and which one it is."""


def test_all_formats_have_a_figure() -> None:
    assert set(FIGURES) == set(exports.formats())


@pytest.mark.parametrize('rate_hz', RATES_HZ)
@pytest.mark.parametrize('name', ['adxl203', 'adxl355', 'mpu6050'])
def test_exports_state_what_was_recorded(name: str, rate_hz: float, tmp_path: Path) -> None:
    pytest.importorskip('jinja2')
    recorded = at_rest(replace(one_axis(name), rate_hz=rate_hz), 3)
    sensor, result = measured(recorded, one_axis(name), tmp_path)
    std_mps2 = sample_std(recorded, sensor)
    exported = exports.Export(sensor, 'unit.yaml', {}, {'white noise': std_mps2 / G0_MPS2}, 0.0)
    for form, (pattern, figure) in FIGURES.items():
        stated = figures(exports.text(form, exported), pattern)[0]
        # Those of the rest are known within 5 %, and N of 11 s within 25 %.
        assert stated == pytest.approx(figure(result, std_mps2), rel=0.25), form
