# SPDX-License-Identifier: Apache-2.0

"""The chain as a call for simulators, compared with a simulated recording."""

from copy import deepcopy
from dataclasses import replace
import pickle
from time import process_time

from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.population import PooledCoefficient, Population
from adxl_ros.model.sensor import put, to_nominal_mps2
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import Response
from adxl_ros.simulate.sensor_model import SensorModel
import numpy as np
import pytest
from units import nominal, with_effects

RATE_HZ = 200.0
STAGE = {
    'backlash',
    'base_tilt',
    'gravity',
    'lever_arm',
    'stage_eccentricity',
    'stage_offset',
    'joint_offset',
    'flexible_link',
    'late_acceleration',
}
CLOCK = {'clock_skew', 'time_offset'}
NOISE = {'bias_walk', 'flicker', 'noise_excess', 'spikes', 'stuck'}
MEAN = [
    'bias',
    'scale_factor',
    'misalignment',
    'cross_axis',
    'cross_axis_z',
    'nonlinearity',
    'hysteresis',
    'temperature_bias',
    'saturation',
]


def unit(*effects, **changes):
    return with_effects(nominal('xyz', rate_hz=RATE_HZ, **changes), effects)


def quiet(*effects):
    return unit(*effects, noise_density_g_per_rthz=np.zeros(3))


def swing(count=300, late_s=0.0):
    """Return specific force of a body that begins to swing smoothly, m/s², (n, 3)."""
    time_s = np.maximum(np.arange(count) / RATE_HZ - late_s, 1e-9)
    time_s = time_s * np.exp(-1 / time_s)
    return G0_MPS2 * np.column_stack(
        [np.sin(7 * time_s), np.cos(5 * time_s), np.sin(3 * time_s + 1)]
    )


def temperature_c(count=300):
    return 25 + 10 * (1 - np.cos(np.arange(count) / 40))


def recorded(sensor, seed):
    """Return the readings of a simulated recording of the same motion, m/s², (n, 3)."""
    force = swing()
    index = lambda time_s: np.rint(time_s * RATE_HZ).astype(int)  # noqa: E731
    motion = Motion(
        len(force) / RATE_HZ,
        internal_rate_hz=RATE_HZ,
        force=lambda time_s: list(force[index(time_s)].T),
        temperature_c=lambda time_s: temperature_c()[index(time_s)],
    )
    volts = Response(sensor, motion, seed)(np.arange(len(force)) / RATE_HZ)
    return to_nominal_mps2(volts, sensor)


def called(sensor, seed, force, begin=0):
    model = SensorModel(sensor, seed)
    return np.array(
        [
            model(f, 1 / RATE_HZ, temperature=t)
            for f, t in zip(force[begin:], temperature_c()[begin:])
        ]
    )


@pytest.mark.parametrize('effect', sorted(set(library()) - STAGE - CLOCK))
def test_one_sensor_reads_what_simulate_records(effect):
    """With noise, filter and ADC, and the same seed."""
    sensor = unit(effect)
    assert called(sensor, 3, swing()) == pytest.approx(recorded(sensor, 3), abs=1e-9)


@pytest.mark.parametrize('effect', sorted(set(library()) - STAGE - CLOCK - NOISE))
def test_sensors_of_a_batch_are_those_alone(effect):
    """Without noise each one reads as alone, whatever the others do."""
    sensor, other = quiet(effect), 0.5 * swing()[::-1]
    batch = called(sensor, 3, np.stack([swing(), other, swing()], axis=1))
    for d, force in ((0, swing()), (1, other), (2, swing())):
        assert batch[:, d] == pytest.approx(called(sensor, 3, force), abs=1e-12)


def test_effects_that_a_simulator_cannot_call_are_named():
    model = SensorModel(unit('bias', 'time_offset:offset_s=-0.01', 'clock_skew', *sorted(STAGE)))
    assert set(model.left_out) == STAGE | CLOCK
    assert 'future' in model.left_out['time_offset']
    assert 'position' in model.left_out['lever_arm']


@pytest.mark.parametrize('delay_s', [0.0012, 0.005, 0.0327])
def test_time_offset_delays_the_force(delay_s):
    """It reads the force of an earlier time, between the steps of the simulator."""
    late, prompt, begin = unit(f'time_offset:offset_s={delay_s}'), unit(), 100
    lsb_mps2 = late.lsb_v / late.nominal_scale_v_per_g[0] * G0_MPS2
    batch, expected = (
        np.stack([force, 0.5 * force], axis=1) for force in (swing(), swing(late_s=delay_s))
    )
    assert called(late, 1, batch)[begin:] == pytest.approx(
        called(prompt, 1, expected)[begin:], abs=2 * lsb_mps2
    )
    assert np.abs(batch - expected)[begin:].max() > 5 * lsb_mps2


@pytest.mark.parametrize(
    ('force', 'dt_s', 'words'),
    [
        ([1.0, 2.0], 0.005, 'expected (3,)'),
        ([1.0, 2.0, np.nan], 0.005, 'not finite'),
        ([0.0, 0.0, 9.8], 0.0, 'positive'),
        ([0.0, 0.0, 9.8], 0.01, 'equal time steps'),
        (np.zeros((4, 3)), 0.005, 'before'),
    ],
)
def test_wrong_calls_are_refused(force, dt_s, words):
    model = SensorModel(unit())
    model([0.0, 0.0, 9.8], 0.005)
    with pytest.raises(UserError) as error:
        model(force, dt_s)
    assert words in str(error.value)


@pytest.mark.perf
def test_4096_sensors_run_in_real_time(capsys):
    """Without noise-like effects, on one core; the ratio to a Gaussian is printed."""
    force, steps = np.random.default_rng(0).normal(size=(4096, 3)), 200
    rng, times_s = np.random.default_rng(0), {}

    def gaussian(force, dt_s):
        return force + rng.standard_normal(force.shape)

    for name, call in (
        ('chain', SensorModel(quiet(*MEAN))),
        ('chain with white noise', SensorModel(unit(*MEAN))),
        ('units that differ', SensorModel(nominal('xyz', rate_hz=RATE_HZ), 0, 'datasheet')),
        ('Gaussian', gaussian),
    ):
        call(force, 1 / RATE_HZ)
        begin_s = process_time()
        for _ in range(steps):
            call(force, 1 / RATE_HZ)
        times_s[name] = process_time() - begin_s
    with capsys.disabled():
        for name, time_s in times_s.items():
            print(
                f'\n4096 sensors, {name}: {1e3 * time_s / steps:.2f} ms a step, '
                f'{time_s / times_s["Gaussian"]:.1f} times a Gaussian',
                end='',
            )
    assert times_s['chain'] < steps / RATE_HZ
    assert times_s['units that differ'] < 1e-3 * steps


@pytest.mark.parametrize('effect', sorted(set(library()) - STAGE - CLOCK - NOISE))
def test_a_sensor_that_is_reset_reads_as_a_new_one(effect):
    """And the others go on as if nothing had happened."""
    sensor, force = quiet(effect, 'time_offset:offset_s=0.012'), swing()
    model, begin = SensorModel(sensor), 120
    batch = np.repeat(force[:, None], 3, axis=1)
    readings = []
    for step, f in enumerate(batch):
        if step == begin:
            model.reset([])
            model.reset(np.array([1]))
        readings.append(model(f, 1 / RATE_HZ, temperature=temperature_c()[step]))
    readings, alone = np.array(readings), called(sensor, 0, force)
    assert readings[:, 0] == pytest.approx(alone, abs=1e-9)
    assert readings[:, 2] == pytest.approx(alone, abs=1e-9)
    assert readings[begin:, 1] == pytest.approx(called(sensor, 0, force, begin), abs=1e-9)


def test_noise_and_drift_of_reset_sensors_are_those_of_others():
    """Sensors that are reset at random have the noise of a single model, and shorter walks."""
    sensor = unit('bias_walk:density_g_per_rts=1e-3')
    model, rng, since = SensorModel(sensor, 1), np.random.default_rng(0), np.zeros(2000)
    for _ in range(60):
        again = rng.random(2000) < 0.05
        model.reset(again)
        since[again] = 0
        readings = model(np.zeros((2000, 3)), 1 / RATE_HZ)[:, 0] / G0_MPS2
        since += 1
    white = SensorModel(unit(), 2)(np.zeros((2000, 3)), 1 / RATE_HZ)[:, 0] / G0_MPS2
    walk = 1e-6 * since / RATE_HZ
    assert np.mean(readings**2) == pytest.approx(np.mean(white**2 + walk), rel=0.1)
    late = since > 30
    assert np.mean(readings[late] ** 2) > 1.5 * np.mean(readings[~late] ** 2)


def test_units_of_a_datasheet_keep_its_tolerances():
    sensor = nominal('xy', rate_hz=RATE_HZ)
    model = SensorModel(sensor, units='datasheet')
    model(np.zeros((5000, 3)), 1 / RATE_HZ)
    of = {str(name): model.coefficients[:, k] for k, name in enumerate(model.draws.names)}
    assert of['bias.offset_v.x'].std() == pytest.approx(0.025, rel=0.05)
    assert np.abs(of['scale_factor.offset_v_per_g.y']).max() <= 0.04
    assert of['scale_factor.offset_v_per_g.y'].std() == pytest.approx(0.04 / 3, rel=0.05)
    first = model.coefficients.copy()
    model.reset(slice(0, 10))
    assert (model.coefficients != first).all(axis=1).tolist() == [True] * 10 + [False] * 4990


def test_units_around_a_calibration_have_its_covariance():
    """The readings spread as the covariance says, with its correlations."""
    names = [
        Coefficient('bias', 'offset_v', 'x'),
        Coefficient('scale_factor', 'offset_v_per_g', 'x'),
    ]
    covariance = np.array([[4e-6, 3e-6], [3e-6, 9e-6]])
    sensor = replace(
        put(quiet('bias', 'scale_factor'), names, [0.02, 0.01]),
        covariance=covariance,
        covariance_names=tuple(names),
        adc_bits=0,
    )
    force = np.tile([G0_MPS2, 0.0, 0.0], (20000, 1))
    readings_g = SensorModel(sensor, units='calibration')(force, 1 / RATE_HZ)[:, 0] / G0_MPS2
    assert readings_g.mean() == pytest.approx(1.03, abs=1e-4)
    assert readings_g.var() == pytest.approx(covariance.sum(), rel=0.05)


def test_units_of_a_fleet(tmp_path):
    pooled = PooledCoefficient(2.45, 1e-3, 0.02, 0.015, 0.03, 0.021, 12)
    calibration_store.write_population(
        tmp_path / 'population.yaml', Population('fleet', {'zero_g_x_v': pooled})
    )
    model = SensorModel(nominal('xyz'), units=tmp_path / 'population.yaml')
    model(np.zeros((5000, 3)), 1 / RATE_HZ)
    assert model.coefficients.mean() == pytest.approx(2.45 - 2.5, abs=2e-3)
    assert model.coefficients.std() == pytest.approx(0.021, rel=0.05)
    with pytest.raises(UserError, match='no coefficients to draw'):
        SensorModel(nominal('xyz'), units='calibration')


@pytest.mark.parametrize('library_name', ['array_api_strict', 'torch', 'jax.numpy'])
def test_arrays_of_other_libraries_have_the_same_numbers(library_name):
    """They come back as arrays of their library and type."""
    pytest.importorskip('array_api_compat')
    xp = pytest.importorskip(library_name)
    force = swing()[:50, None] + np.zeros((1, 4, 1))
    model, other = SensorModel(unit(*MEAN), 3), SensorModel(unit(*MEAN), 3)
    for f in force:
        given = xp.asarray(f, dtype=xp.float32)
        readings = other(given, 1 / RATE_HZ)
        assert type(readings) is type(given) and readings.dtype == given.dtype
        assert np.asarray(readings) == pytest.approx(
            model(f.astype(np.float32), 1 / RATE_HZ), abs=1e-6
        )


def test_the_filter_does_not_ring_after_a_step():
    """A foot in contact: between two steps the force is a straight line."""
    dt_s, steps = 1 / RATE_HZ, 6
    sensor = quiet()
    sensor = replace(sensor, adc_bits=0)
    model, force = SensorModel(sensor), np.array([0.0, 0.0, 1.0])
    for _ in range(10):
        model(force, dt_s)
    readings = [float(model(force * 0, dt_s)[2]) for _ in range(steps)]
    fine = np.arange(0, steps * dt_s, dt_s / 1000)
    falling = np.interp(fine, [0, dt_s], [1.0, 0.0])
    expected, output = [], 1.0
    for i, value in enumerate(falling):
        output += (value - output) * dt_s / 1000 / sensor.rc_s
        if i % 1000 == 999:
            expected.append(output)
    assert readings == pytest.approx(expected, abs=2e-3)


def test_a_filter_that_is_digital_follows_the_time_steps():
    sensor = quiet()
    at_file, at_slow = (
        SensorModel(replace(sensor, adc_bits=0, filter_rate_hz=RATE_HZ)) for _ in range(2)
    )
    for value in (0.0, 0.0, 1.0, 1.0, 0.0):
        force = np.array([value, 0.0, 0.0])
        assert at_file(force, 1 / RATE_HZ) == pytest.approx(at_slow(force, 10 / RATE_HZ))


@pytest.mark.parametrize('effect', ['temperature_bias', 'hysteresis', 'flicker', 'stuck'])
def test_a_copy_goes_on_as_the_original(effect):
    model = SensorModel(unit(effect))
    force = swing(20)
    for row in force[:10]:
        model(row, 1 / RATE_HZ)
    copies = pickle.loads(pickle.dumps(model)), deepcopy(model)
    for row in force[10:]:
        expected = model(row, 1 / RATE_HZ)
        assert all(np.array_equal(other(row, 1 / RATE_HZ), expected) for other in copies)


def test_the_type_of_the_readings_is_that_of_the_force():
    for kind, expected in (('float32', 'float32'), ('float64', 'float64'), ('int64', 'float64')):
        assert SensorModel(unit())(np.ones((2, 3), kind), 0.01).dtype == expected


@pytest.mark.parametrize('units', [None, 'datasheet'])
def test_a_seed_of_reset_is_that_of_a_new_model(units):
    """As gymnasium's check_env asks for."""
    sensor, force = unit('flicker', 'bias_walk'), np.tile(swing(1), (3, 1))
    model, new = SensorModel(sensor, 1, units), SensorModel(sensor, 5, units)
    model(force, 0.01)
    expected = [new(force, 0.01) for _ in range(5)]
    for _ in range(2):
        model.reset(seed=5)
        assert np.array_equal([model(force, 0.01) for _ in range(5)], expected)
