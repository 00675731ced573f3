# SPDX-License-Identifier: Apache-2.0

"""The simulator by its command line and against theory: rate, noise, motion, recordings."""

from dataclasses import replace

from adxl_ros.files import parameter_file, recording
from adxl_ros.model import noise
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import ActsOn, Coefficient, Need
from adxl_ros.model.sensor import put, typical, with_neutral
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import simulate
from adxl_ros.simulate.trajectories import rich, TRAJECTORIES
import numpy as np
from pace import within
import pytest
from scipy.signal import welch
from units import nominal

pytestmark = pytest.mark.long

G = 9.80665
CLEAN = {'noise_density_g_per_rthz': np.zeros(3), 'adc_bits': 0}


def with_all(sensor, acts_on=tuple(ActsOn)):
    names = [
        name for name, e in library().items() if e.acts_on in acts_on and Need.ROBOT not in e.needs
    ]
    values = {name: typical(library()[name], sensor.axes) for name in names}
    return replace(sensor, effects=tuple(names), values=values)


@pytest.mark.parametrize('everything', [False, True])
def test_rich_at_250_hz_equals_rich_at_16_khz(everything):
    sensor = nominal('xyz', **CLEAN)
    if everything:
        sensor = with_all(sensor, (ActsOn.MEAN,))
        sensor = put(
            sensor, [Coefficient('saturation', 'limit_g', axis) for axis in 'xyz'], [1000.0] * 3
        )
    motion = rich(np.random.default_rng(0))
    if everything:
        motion = replace(motion, duration_s=150.0)
    slow, fast = (simulate(replace(sensor, rate_hz=rate), motion, 0) for rate in (250.0, 16000.0))
    for name in ('x_v', 'y_v', 'z_v'):
        difference_v = slow[name] - fast[name][::64][: len(slow[name])]
        assert np.sqrt(np.mean(difference_v**2)) < 1e-6


@pytest.mark.parametrize('name', sorted(TRAJECTORIES))
def test_velocity_and_acceleration_are_derivatives_of_the_position(name):
    """All manoeuvres but `motion` also begin and end at rest."""
    motion = TRAJECTORIES[name](np.random.default_rng(0))
    time_s = np.linspace(0, min(motion.duration_s, 300.0), 300001)
    for joint in (motion.alpha, motion.beta, motion.shift):
        position, velocity, acceleration = (joint(time_s, order) for order in range(3))
        by_s = 1 / time_s[1]
        assert np.abs(np.gradient(position) * by_s - velocity)[2:-2].max() < 1e-3
        assert np.abs(np.gradient(velocity) * by_s - acceleration)[2:-2].max() < 0.05
    if name != 'motion':
        for joint in (motion.alpha, motion.beta, motion.shift):
            assert np.abs(joint(np.array([0.0, motion.duration_s]), 1)).max() < 1e-9


@pytest.mark.perf
def test_ten_minutes_with_all_effects_take_seconds():
    sensor, motion = with_all(nominal('xyz')), rich(np.random.default_rng(0))
    with within(3.0 * motion.duration_s / 600):
        simulate(sensor, motion, 0)


def test_noise_has_the_stated_spectrum_and_allan_deviation():
    sensor = nominal('xyz', adc_bits=0)
    data = np.concatenate(
        [
            np.column_stack([simulate(sensor, Motion(3000.0), seed)[f'{a}_v'] for a in 'xyz'])
            for seed in range(2)
        ],
        axis=1,
    )
    f, density = welch(data, 1000.0, nperseg=8192, axis=0)
    density = density.mean(axis=1)
    decay = np.exp(-1e-3 / sensor.rc_s)
    # One-sided density of an AR(1) sequence of the filter's variance.
    variance = noise.analog_std_v(sensor)[0] ** 2
    theory = (
        2e-3
        * variance
        * (1 - decay**2)
        / (1 - 2 * decay * np.cos(2 * np.pi * f * 1e-3) + decay**2)
    )
    for low, high in ((0.5, 3), (3, 15), (15, 60), (60, 450)):
        band = (f > low) & (f < high)
        assert density[band].mean() == pytest.approx(theory[band].mean(), rel=0.03)
    assert np.sqrt(density[(f > 0.3) & (f < 2)].mean()) == pytest.approx(110e-6, rel=0.03)
    for length in (10, 100, 1000):
        means = (
            data[: len(data) // length * length].reshape(-1, length, data.shape[1]).mean(axis=1)
        )
        deviation_v = np.sqrt(np.mean(np.diff(means, axis=0) ** 2) / 2)
        expected_v = np.sqrt(allan_variance(variance, decay, length))
        assert deviation_v == pytest.approx(expected_v, rel=0.03)


def allan_variance(variance, decay, length):
    """Return the Allan variance of an AR(1) sequence for means of `length` samples."""
    lag = np.arange(1 - length, length)
    weight = length - np.abs(lag)
    same = np.sum(weight * decay ** np.abs(lag))
    adjacent = np.sum(weight * decay ** np.abs(lag + length))
    return variance * (same - adjacent) / length**2


def test_a_recording_is_simulated_again(run_tool, tmp_path):
    first, second = tmp_path / 'first.csv', tmp_path / 'second.mcap'
    for args in (
        ('rich', '--rate', '100', '--effect', 'lever_arm:z_m=0.05', '-o', str(first)),
        (str(first), '--effect', 'lever_arm:z_m=0.05', '--seed', '1', '-o', str(second)),
    ):
        done = run_tool('simulate', *args)
        assert done.returncode == 0, done.stderr
    original, repeated = recording.read(first), recording.read(second)
    np.testing.assert_array_equal(original.columns['alpha_rad'], repeated.columns['alpha_rad'])
    np.testing.assert_allclose(original.time_s, repeated.time_s, atol=1e-9)
    volts = [r.volts(nominal('xy')) for r in (original, repeated)]
    # Noise of both, and the encoder's step of 1.45 mrad: 0.42 mg.
    assert np.sqrt(np.mean((volts[0] - volts[1]) ** 2)) < 1.1e-3


def test_a_recorded_specific_force_passes_through_the_chain(run_tool, tmp_path):
    time_s = np.arange(4000) / 200
    force = np.column_stack([np.sin(time_s), np.cos(3 * time_s), np.full(4000, G)])
    lines = ['time_s,ax_mps2,ay_mps2,az_mps2'] + [
        ','.join(map(repr, map(float, row))) for row in np.column_stack([time_s, force])
    ]
    ideal = tmp_path / 'ideal.csv'
    ideal.write_text('\n'.join(lines) + '\n')
    for rate in ((), ('--rate', '1000')):
        out = tmp_path / 'out.csv'
        done = run_tool('simulate', 'imu', '--force', str(ideal), *rate, '-o', str(out))
        assert done.returncode == 0, done.stderr
        read = recording.read(out)
        assert len(read) == pytest.approx(4000 * (5 if rate else 1), abs=5)
        expected = 2.5 + np.sin(read.time_s - 32e3 * 0.33e-6) / G
        assert np.sqrt(np.mean((read.columns['x_v'] - expected)[500:] ** 2)) < 0.6e-3


@pytest.mark.parametrize(
    'args, message',
    [
        (('rich', '--effect', 'lever_am'), "unknown effect 'lever_am'; known: "),
        (('rich', '--effect', 'lever_arm:zm=1'), "no parameter 'zm', but x_m, y_m, z_m"),
        (('rich', '--effect', 'lever_arm:z_m=3'), "'3' is not a number from -2 to 2 (m)"),
        (('rich', '--effect', 'lever_arm:z_m.x=1'), 'it is one number'),
        (('rich', '--effect', 'temperature_bias:per_k=0.1mg/K'), '(g/K)'),
        (('rich', '--effect', 'bias:offset_v=nine'), "'nine' is not a number"),
        (('rich', '--effect', 'cross_axis:linear.z=0.1'), "no axis 'z' to act on"),
        (('rich', '--rate', '0'), 'outside 0.01 to 100000 Hz'),
        (('rich', '--params', 'none.yaml'), 'none.yaml: cannot be read'),
        (('imu',), '--force RECORDING'),
    ],
)
def test_bad_input_is_one_line_and_no_file(run_tool, tmp_path, args, message):
    out = tmp_path / 'out.csv'
    done = run_tool('simulate', *args, '-o', str(out))
    assert done.returncode == 1 and message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 and not out.exists()


def test_apply_corrects_for_temperature_and_supply(run_tool, tmp_path):
    effects = ('--effect', 'supply', '--effect', 'temperature_bias:per_k=1e-3')
    made = run_tool('simulate', 'soak', '--rate', '2', *effects, '-o', 'soak.csv')
    assert made.returncode == 0, made.stderr
    sensor = with_neutral(nominal('xy'), ['supply', 'temperature_bias'])
    sensor = replace(
        sensor,
        values={
            **sensor.values,
            'supply': typical(library()['supply'], 'xy'),
            'temperature_bias': {'per_k': np.full(2, 1e-3)},
        },
    )
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    done = run_tool('apply', 'soak.csv', '--params', 'unit.yaml', '-o', 'out.csv')
    assert done.returncode == 0 and not done.stderr
    ax = np.genfromtxt(tmp_path / 'out.csv', delimiter=',', names=True)['ax_mps2']
    assert np.abs(ax - G * np.sin(np.radians(60)) * np.cos(np.radians(30))).max() < 0.03
    bare = [
        ','.join(line.split(',')[:3]) if line[0] != '#' else line
        for line in (tmp_path / 'soak.csv').read_text().splitlines()
    ]
    (tmp_path / 'bare.csv').write_text('\n'.join(bare) + '\n')
    done = run_tool('apply', 'bare.csv', '--params', 'unit.yaml', '-o', 'out.csv')
    assert done.returncode == 0 and 'supply_v is not recorded' in done.stdout
