# SPDX-License-Identifier: Apache-2.0

"""The chain as a call for simulators, compared with a simulated recording."""

from time import process_time

from adxl_ros.errors import UserError
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import to_nominal_mps2
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import Response
from adxl_ros.simulate.sensor_model import SensorModel
from adxl_ros.tools.command_line import with_effects
import numpy as np
import pytest
from units import nominal

RATE_HZ = 200.0
STAGE = {'backlash', 'base_tilt', 'gravity', 'lever_arm', 'stage_eccentricity', 'stage_offset'}
CLOCK = {'clock_skew', 'time_offset'}
NOISE = {'bias_walk', 'flicker', 'noise_excess', 'spikes', 'stuck'}
MEAN = ['bias', 'scale_factor', 'misalignment', 'cross_axis', 'cross_axis_z', 'nonlinearity',
        'hysteresis', 'temperature_bias', 'saturation']


def unit(*effects, **changes):
    return with_effects(nominal('xyz', rate_hz=RATE_HZ, **changes), effects)


def quiet(*effects):
    return unit(*effects, noise_density_g_per_rthz=np.zeros(3))


def swing(count=300):
    """Return specific force of a swinging body, m/s², (n, 3)."""
    time_s = np.arange(count) / RATE_HZ
    return G0_MPS2 * np.column_stack([np.sin(7 * time_s), np.cos(5 * time_s),
                                      np.sin(3 * time_s + 1)])


def temperature_c(count=300):
    return 25 + 10 * np.sin(np.arange(count) / 40)


def recorded(sensor, seed):
    """Return the readings of a simulated recording of the same motion, m/s², (n, 3)."""
    force = swing()
    index = lambda time_s: np.rint(time_s * RATE_HZ).astype(int)  # noqa: E731
    motion = Motion(len(force) / RATE_HZ, internal_rate_hz=RATE_HZ,
                    force=lambda time_s: list(force[index(time_s)].T),
                    temperature_c=lambda time_s: temperature_c()[index(time_s)])
    volts = Response(sensor, motion, seed)(np.arange(len(force)) / RATE_HZ)
    return to_nominal_mps2(volts, sensor)


def called(sensor, seed, force):
    model = SensorModel(sensor, seed)
    return np.array([model(f, 1 / RATE_HZ, temperature=t)
                     for f, t in zip(force, temperature_c())])


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
    def force(time_s):
        return G0_MPS2 * np.stack([np.sin(7 * time_s), np.cos(5 * time_s), np.sin(3 * time_s)], -1)

    time_s = np.arange(300) / RATE_HZ
    late, prompt = unit(f'time_offset:offset_s={delay_s}'), unit()
    begin = 100
    batch = np.stack([force(time_s), 0.5 * force(time_s)], axis=1)
    expected = np.stack([force(time_s - delay_s), 0.5 * force(time_s - delay_s)], axis=1)
    assert called(late, 1, batch)[begin:] == pytest.approx(
        called(prompt, 1, expected)[begin:], abs=2 * lsb_mps2(late))
    assert np.abs(batch - expected)[begin:].max() > 5 * lsb_mps2(late)


def lsb_mps2(sensor):
    return sensor.lsb_v / sensor.nominal_scale_v_per_g[0] * G0_MPS2


@pytest.mark.parametrize(('force', 'dt_s', 'words'), [
    ([1.0, 2.0], 0.005, 'expected (3,)'), ([1.0, 2.0, np.nan], 0.005, 'not finite'),
    ([0.0, 0.0, 9.8], 0.0, 'positive'), ([0.0, 0.0, 9.8], 0.01, 'equal time steps'),
    (np.zeros((4, 3)), 0.005, 'before')])
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

    for name, call in (('chain', SensorModel(quiet(*MEAN))),
                       ('chain with white noise', SensorModel(unit(*MEAN))),
                       ('Gaussian', gaussian)):
        call(force, 1 / RATE_HZ)
        begin_s = process_time()
        for _ in range(steps):
            call(force, 1 / RATE_HZ)
        times_s[name] = process_time() - begin_s
    with capsys.disabled():
        for name, time_s in times_s.items():
            print(f'\n4096 sensors, {name}: {1e3 * time_s / steps:.2f} ms a step, '
                  f'{time_s / times_s["Gaussian"]:.1f} times a Gaussian', end='')
    assert times_s['chain'] < steps / RATE_HZ
