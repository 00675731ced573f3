# SPDX-License-Identifier: Apache-2.0

"""The length of gravity over rests: units, errors and the tolerance of each sensor."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor, to_volts
from adxl_ros.signals.findings import check_recording
from adxl_ros.signals.gravity_at_rest import (
    GravityAtRest,
    GravityFaultKind,
    look,
    of_volts,
    require_unit,
    RestReadings,
)
from adxl_ros.signals.recorded_gravity import LiveLook, RecordingLook
from adxl_ros.signals.tolerances import IDEAL, nominal_tolerance
import numpy as np
import pytest

PARAMS = Path(__file__).parents[2] / 'params'
REAL = Path(__file__).parents[3] / 'shared' / 'real'
FACES = np.array(
    [
        [0, 0, 1.0],
        [0, 0, -1],
        [0, 1, 0],
        [0, -1, 0],
        [1, 0, 0],
        [-1, 0, 0],
        [0.6, 0.8, 0],
        [0, 0.6, -0.8],
        [-0.6, 0, 0.8],
    ]
)
"""Directions of the force in nine rests."""
G = G0_MPS2


def sensor(name: str = 'any_imu') -> Sensor:
    return parameter_file.load(str(PARAMS / f'{name}.yaml'), may_measure=True)


def looked(
    readings: np.ndarray, unit: Sensor | None = None, noise_mps2: float = 0.001
) -> GravityAtRest:
    unit = unit or sensor()
    return look(
        RestReadings(readings, np.full_like(readings, noise_mps2)), nominal_tolerance(unit)
    )


def kind(readings: np.ndarray, unit: Sensor | None = None) -> GravityFaultKind | None:
    fault = looked(readings, unit).fault
    return fault and fault.kind


def test_length_spread_and_limits_of_a_sound_sensor() -> None:
    gravity = looked(G * FACES + [0.05, -0.1, 0.2])
    assert gravity.fault is None
    assert (gravity.rests, gravity.axes) == (9, 3)
    assert gravity.length_mps2 == pytest.approx(G, abs=0.2)
    assert 0 < gravity.spread_mps2 < 0.4
    assert gravity.allowed_mps2[0] < G < gravity.allowed_mps2[1]


@pytest.mark.parametrize(
    ('number', 'unit', 'option'),
    [
        (1.0, 'g', '--unit g'),
        (1000.0, 'mg', '--unit mg'),
        (1000 * G, 'mm/s²', '--unit mmps2'),
        (G / 0.3048, 'ft/s²', '0.3048'),
        (100 * G, 'cm/s²', '100'),
        (G / 1000, 'divided by', '1000'),
        (G * G, 'as g', '--unit mps2'),
        (256.0, '256', '--lsb-per-g 256'),
        (16384.0, '16384', '--lsb-per-g 16384'),
    ],
)
@pytest.mark.parametrize('poses', [1, 9])
def test_each_unit_is_named_with_the_option_that_states_it(
    number: float, unit: str, option: str, poses: int
) -> None:
    readings = number * (FACES[:poses] + [0.01, -0.02, 0.002])
    gravity = look(RestReadings(readings, 1e-3 * np.abs(readings)), nominal_tolerance(sensor()))
    assert gravity.fault is not None and gravity.fault.kind is GravityFaultKind.UNIT
    assert unit in gravity.fault.unit and option in gravity.fault.remedy
    assert gravity.fault.factor == pytest.approx(G / number)
    with pytest.raises(UserError, match='at rest'):
        require_unit(gravity, 'log.csv')


@pytest.mark.parametrize('scale', [0.68, 1.5, 2.0])
def test_a_scale_that_no_unit_explains_is_a_warning(scale: float) -> None:
    gravity = looked(scale * G * FACES)
    assert gravity.fault is not None and gravity.fault.kind is GravityFaultKind.SCALE
    (line,) = require_unit(gravity, 'log.csv', needs_gravity=True)
    assert f'{scale * G:.3g} m/s²' in line


def test_counts_around_the_middle_of_their_range_are_in_no_other_unit() -> None:
    fault = looked(G * (FACES + 2.0)).fault
    assert fault is not None and fault.kind is GravityFaultKind.SCALE
    assert 'zero-g of x 2, y 2, z 2 g' in fault.reason


def test_gravity_that_was_taken_away() -> None:
    readings = np.tile([0.25, -0.15, 0.4], (5, 1))
    assert kind(readings) is GravityFaultKind.REMOVED
    assert len(require_unit(looked(readings), 'log.csv')) == 1
    with pytest.raises(UserError, match='gravity is missing'):
        require_unit(looked(readings), 'log.csv', needs_gravity=True)


@pytest.mark.parametrize(
    ('factors', 'stated'),
    [
        ((1 / G, 1, 1), 'x in g'),
        ((1, 1, 1000), 'z in mm/s²'),
        ((1000 / G, 1000 / G, 1), 'y in mg'),
    ],
)
def test_axes_in_different_units(factors: tuple[float, float, float], stated: str) -> None:
    fault = looked((G * FACES + [0.1, -0.2, 0.15]) * factors).fault
    assert fault is not None and fault.kind is GravityFaultKind.MIXED_UNITS
    assert stated in fault.unit
    assert fault.data_fault == 'unit'


def test_a_sensor_that_was_exchanged_shows_in_the_spread() -> None:
    first, second = G * FACES + [0, 0, 3.0], G * FACES - [0, 0, 3.0]
    assert kind(np.concatenate([first, second])) is GravityFaultKind.SPREAD


def test_a_quarter_of_the_rests_may_be_steady_accelerations() -> None:
    curve = np.tile([0.0, 6.0, G], (3, 1))
    assert kind(np.concatenate([G * FACES, curve])) is None


def test_two_axes_have_an_upper_limit_only() -> None:
    unit = sensor('adxl203')
    assert kind(0.1 * G * FACES[:, :2], unit) is None
    assert kind(1000 * FACES[:, :2], unit) is GravityFaultKind.UNIT
    assert kind(2 * G * FACES[:, :2], unit) is GravityFaultKind.SCALE
    assert 'not checked' in looked(G * FACES[:, :2], unit).text


def test_nothing_rests() -> None:
    gravity = looked(np.zeros((0, 3)))
    assert gravity.fault is None and 'not checked' in gravity.text
    assert gravity.as_json()['rests'] == 0


@pytest.mark.parametrize('name', sorted(path.stem for path in PARAMS.glob('*.yaml')))
def test_every_sensor_at_the_limits_of_its_tolerance_is_sound(name: str) -> None:
    unit = sensor(name)
    axes, tolerance = len(unit.axes), nominal_tolerance(sensor(name))
    rng = np.random.default_rng(5)
    for _ in range(20):
        directions = rng.normal(size=(rng.integers(1, 30), 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        for forces in (G * FACES, G * directions):
            readings = forces[:, :axes] * (
                1 + tolerance.scale * rng.choice([-1, 1], axes)
            ) + tolerance.zero_g_mps2 * rng.choice([-1, 1], axes)
            assert kind(readings, unit) is None


def test_the_datasheet_decides() -> None:
    stated, unstated = sensor('adxl355'), sensor()
    assert kind(G * FACES + [0, 0, 1.5], unstated) is None
    tight = replace(
        stated,
        datasheet={
            Coefficient('bias', 'offset_v'): (0.0, 0.01),
            Coefficient('scale_factor', 'offset_v_per_g'): (0.0, 0.01),
        },
    )
    assert kind(G * FACES[:1] + [0, 0, 1.5], tight) is GravityFaultKind.SCALE


def test_a_calibrated_sensor_is_judged_by_its_calibration() -> None:
    nominal = sensor()
    values = {
        'bias': {'offset_v': np.array([0.0, 0.0, 0.3])},
        'scale_factor': {'offset_v_per_g': np.array([-0.3, -0.3, -0.3])},
    }
    fitted = replace(nominal, effects=('bias', 'scale_factor'), values=values)
    volts = FACES * fitted.scale_v_per_g + fitted.zero_g_v
    std = np.full_like(volts, 1e-4)
    assert of_volts(volts, std, nominal).fault is not None
    assert of_volts(volts, std, fitted).fault is None
    fault = of_volts(1000 * volts, std, fitted).fault
    assert fault is not None and of_volts(volts + 0.1, std, fitted).fault is not None


def test_the_reference_of_another_simulator_has_the_tolerance_of_gravity() -> None:
    still = np.zeros((2, 3))
    for length, expected in (
        (9.81, None),
        (1.0, GravityFaultKind.UNIT),
        (0.0, GravityFaultKind.REMOVED),
    ):
        fault = look(RestReadings(length * FACES[:2], still), IDEAL).fault
        assert (fault and fault.kind) is expected


def tumble(rate_hz: float, rests: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and forces of rests of four seconds in different directions."""
    directions = np.repeat(FACES[:rests], round(4 * rate_hz), axis=0)
    noise = np.random.default_rng(2).normal(0, 0.02, directions.shape)
    return np.arange(len(directions)) / rate_hz, G * directions + noise


def read(time_s: np.ndarray, force: np.ndarray) -> recording.Recording:
    return recording.Recording(
        'made.csv', time_s, dict(zip(('ax_mps2', 'ay_mps2', 'az_mps2'), force.T))
    )


@pytest.mark.parametrize('rate_hz', [20.0, 100.0, 1000.0, 3200.0])
@pytest.mark.parametrize(
    ('change', 'expected'),
    [
        (lambda force: force, None),
        (lambda force: force / G, GravityFaultKind.UNIT),
        (lambda force: force * [1 / G, 1, 1], GravityFaultKind.MIXED_UNITS),
    ],
)
def test_a_recording_of_any_rate(rate_hz: float, change: Callable, expected: object) -> None:
    time_s, force = tumble(rate_hz)
    made = read(time_s, change(force))
    taken = RecordingLook(sensor(), made)
    taken.feed(made)
    fault = taken.gravity().fault
    assert (fault and fault.kind) is expected


def test_a_live_stream_is_judged_from_its_first_rest_on() -> None:
    unit, live = (
        replace(sensor(), noise_density_g_per_rthz=np.full(3, 4e-4), unstated=()),
        LiveLook(),
    )
    time_s, force = tumble(100.0, 1)
    stamps_ns = (time_s * 1e9).astype(np.int64)
    gravity = live(unit, 100.0, stamps_ns, force / G)
    assert gravity.fault is not None and gravity.fault.kind is GravityFaultKind.UNIT
    # The driver was mended.
    assert live(unit, 100.0, stamps_ns, force).fault is None


def test_volts_are_judged_by_the_nominal_values() -> None:
    unit = sensor('mpu6050')
    volts = to_volts(G * FACES, unit)
    assert of_volts(volts, np.full_like(volts, 1e-4), unit).fault is None
    halved = replace(unit, nominal_scale_v_per_g=2 * unit.nominal_scale_v_per_g)
    assert of_volts(volts, np.full_like(volts, 1e-4), halved).fault is not None


@pytest.mark.skipif(not REAL.is_dir(), reason='the real recordings are not beside the package')
@pytest.mark.parametrize('path', sorted(REAL.glob('*.csv')) if REAL.is_dir() else [], ids=str)
def test_real_recordings_are_sound(path: Path) -> None:
    assert check_recording(str(path), None, recording.ReadingOptions()).faults == ()


@pytest.mark.parametrize('name', ['m/s² divided by 1000', 'g divided by 1000'])
def test_a_unit_in_which_motion_is_below_the_stated_noise(name: str) -> None:
    """By the noise of the sensor all of it is one rest, whose mean is of no orientation."""
    unit = replace(sensor(), noise_density_g_per_rthz=np.full(3, 4e-4), unstated=())
    time_s, force = tumble(100.0)
    made = read(
        time_s, force * {'m/s² divided by 1000': 1e-3, 'g divided by 1000': 1e-3 / G}[name]
    )
    taken = RecordingLook(unit, made)
    taken.feed(made)
    fault = taken.gravity().fault
    assert fault is not None and fault.unit == name
