# SPDX-License-Identifier: Apache-2.0

"""Each effect: neutral values change nothing, blocks join, tangents agree, closed forms hold."""

from dataclasses import replace
from functools import cache

from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.effects import library
from adxl_ros.model.effects.adc import flicker_filter
from adxl_ros.model.effects.base import ActsOn, Coefficient, Need, Place
from adxl_ros.model.filters import low_pass, play, resonator
from adxl_ros.model.sensor import get, names_of, parameter_of, put, typical, with_neutral
from adxl_ros.simulate.motion import ForcePath, Held, Knots, Motion
from adxl_ros.simulate.response import Response, simulate
from adxl_ros.simulate.trajectories import Steps
import numpy as np
import pytest
from scipy.signal import sosfreqz, welch
from units import nominal

G = 9.80665
NAMES = sorted(library())
CLEAN = {'noise_density_g_per_rthz': np.zeros(3), 'adc_bits': 0}
MOTION = Motion(
    12.0,
    Knots([0, 1, 3, 5, 7, 12], [0.5, 0.5, 1.2, 0.9, 2.0, 2.0]),
    Knots([0, 2, 4, 5, 12], [0, 0, 2, 1.5, 3]),
    Knots([0, 6, 7, 12], [0, 0, 0.02, 0]),
    temperature_c=Steps(25.0, ((2.0, 35.0), (7.0, 20.0)), 1.0),
    supply_v=Steps(5.0, ((4.0, 4.8),), 0.5),
)


_TIME_S = np.arange(0.0, 12.0, 0.01)


class RobotForce(ForcePath):
    is_robot = True

    def __init__(self, time_s, force_mps2):
        super().__init__(time_s, force_mps2)
        self.modes = {
            name: np.roll(force_mps2, k + 1, axis=1)
            for k, name in enumerate(
                (*(f'joint{n}' for n in range(1, 9)), 'flexible', 'late_acceleration')
            )
        }


FOLLOWED = Motion(
    12.0,
    force=RobotForce(
        _TIME_S,
        G
        * np.column_stack(
            [0.3 * np.sin(9 * _TIME_S), 0.4 * np.cos(5 * _TIME_S), 1 + 0.2 * np.sin(23 * _TIME_S)]
        ),
    ),
    temperature_c=MOTION.temperature_c,
    supply_v=MOTION.supply_v,
)


def with_effect(name, sensor=None, **changes):
    sensor = sensor or nominal('xyz', **CLEAN)
    values = {
        **typical(library()[name], sensor.axes),
        **{k: np.asarray(v, float) for k, v in changes.items()},
    }
    return replace(sensor, effects=(name,), values={name: values})


def motion_of(name):
    """Return a motion on which an effect acts: errors of a reference act on a recorded force."""
    return FOLLOWED if library()[name].place is Place.REFERENCE else MOTION


def volts(sensor, motion=None, seed=1):
    if motion is None:
        motion = motion_of(sensor.effects[0]) if sensor.effects else MOTION
    columns = simulate(sensor, motion, seed)
    return np.column_stack([columns[f'{axis}_v'] for axis in sensor.axes])


@pytest.fixture(scope='module')
def plain():
    return cache(lambda name: volts(nominal('xyz'), motion_of(name)))


def test_the_library_has_the_documented_effects():
    names = (
        'bias scale_factor cross_axis scale_factor_z cross_axis_z misalignment '
        'nonlinearity quadratic hysteresis bandwidth mount_resonance temperature_bias '
        'temperature_scale warm_up bias_walk supply saturation quantisation adc_inl '
        'noise_excess flicker mains_hum spikes stuck vibration_rectification time_offset '
        'clock_skew gravity base_tilt stage_offset stage_eccentricity backlash lever_arm '
        'thermal_lag thermal_hysteresis reference_filter reference_delay reference_frame'
    )
    listed = names.split()
    assert not set(listed) - set(NAMES)


@pytest.mark.parametrize('name', NAMES)
def test_neutral_is_identity_to_the_bit(name, plain):
    np.testing.assert_array_equal(volts(with_neutral(nominal('xyz'), [name])), plain(name))


@pytest.mark.parametrize('name', NAMES)
def test_typical_values_change_a_recording_and_blocks_join(name, plain):
    sensor = with_effect(name, nominal('xyz'))
    if name == 'saturation':
        sensor = put(sensor, [Coefficient('saturation', 'limit_g', 'z')], [0.3])
    if name == 'spikes' or name == 'stuck':
        sensor = put(sensor, [Coefficient(name, 'rate_hz')], [3.0])
    all_at_once_v = volts(sensor)
    assert np.abs(all_at_once_v - plain(name)).max() > 5e-5
    respond = Response(sensor, motion_of(name), 1)
    stamps = np.arange(len(all_at_once_v)) / sensor.rate_hz
    # Short blocks of a live sensor, and long ones of a file.
    bounds = [1, 3, 53, *range(777, len(stamps), 777)]
    parts = [respond(part) for part in np.split(stamps, bounds)]
    np.testing.assert_array_equal(np.vstack(parts), all_at_once_v)


@pytest.mark.parametrize(
    'name', [n for n in NAMES if library()[n].smooth and library()[n].acts_on is ActsOn.MEAN]
)
def test_tangents_do_not_depend_on_the_step(name):
    sensor = with_effect(name)
    for coefficient in names_of(library()[name], 'xyz'):
        value, scale = get(sensor, [coefficient])[0], parameter_of(coefficient).scale
        slopes = [
            (
                volts(put(sensor, [coefficient], [value + step]))
                - volts(put(sensor, [coefficient], [value - step]))
            )
            / (2 * step)
            for step in (1e-3 * scale, 2e-4 * scale)
        ]
        size = np.abs(slopes[0]).max()
        assert np.abs(slopes[0] - slopes[1]).max() <= 2e-3 * size + 1e-9 / scale


@pytest.mark.parametrize('name', NAMES)
def test_bounds_contain_neutral_and_typical_values(name):
    effect = library()[name]
    assert effect.cause.endswith('.')
    for p in effect.parameters:
        assert p.unit and p.source and p.doc and p.scale > 0
        for value in (p.neutral, p.scale if p.typical is None else p.typical):
            assert p.lower <= value <= p.upper


def test_resonance():
    """At its natural frequency a resonator has the gain 1/(2·ζ) and a phase of −90°."""
    time_s = np.arange(20000) / 4000
    out = resonator(np.sin(2 * np.pi * 80 * time_s), 80.0, 0.05, 1 / 4000, {})
    wave = 2j * (out * np.exp(-2j * np.pi * 80 * time_s))[10000:].mean()
    assert abs(wave) == pytest.approx(10.0, rel=1e-4)
    assert np.degrees(np.angle(wave)) == pytest.approx(-90.0, abs=0.01)


def test_some_outputs_of_a_low_pass_are_those_of_all():
    x = np.cumsum(np.random.default_rng(0).standard_normal(1000))
    assert low_pass(x, 3e-3, 4e-3, {}, every=3) == pytest.approx(low_pass(x, 3e-3, 4e-3, {})[::3])


def test_area_of_the_loop_of_play():
    """A cycle of amplitude A through a dead band 2·r encloses 4·r·(A − r)."""
    x = np.tile(np.concatenate([np.linspace(-1, 1, 4001), np.linspace(1, -1, 4001)]), 2)
    y = play(x, 0.3, {})
    cycle = slice(8002, None)
    area = abs(np.sum(np.diff(y[cycle]) * (x[cycle][1:] + x[cycle][:-1]) / 2))
    assert area == pytest.approx(4 * 0.3 * (1 - 0.3), rel=1e-3)


def test_play_equals_its_recursion():
    """The algorithm by turning points equals yₙ = max(xₙ − r, min(xₙ + r, yₙ₋₁)) to the bit."""
    x = np.round(np.cumsum(np.random.default_rng(0).normal(size=5000)), 1)
    output, expected = x[0], []
    for position in x:
        output = max(position - 2, min(position + 2, output))
        expected.append(output)
    memory = {}
    parts = [play(x[i : i + 61], 2, memory) for i in range(0, len(x), 61)]
    np.testing.assert_array_equal(np.concatenate(parts), expected)


def test_lever_arm_is_centripetal_and_tangential():
    """The force is ω²·r towards the axis, and ω̇·r across it while the speed grows."""
    spin = Motion(9.0, Held(0.0), Knots([0, 2, 8, 9], [0, 3, 21, 22.5], [0, 3, 3, 0]))
    difference_mps2 = (
        volts(with_effect('lever_arm', x_m=0.1, y_m=0.0, z_m=0.0), spin)
        - volts(nominal('xyz', **CLEAN), spin)
    ) * G
    assert difference_mps2[5000] == pytest.approx([-0.9, 0.0, 0.0], abs=1e-6)
    growth = spin.beta(np.array([1.0]), 2)[0]
    assert growth > 1.0
    slow = with_effect(
        'lever_arm',
        nominal('xyz', **{**CLEAN, 'rc_capacitance_f': 0.0}),
        x_m=0.1,
        y_m=0.0,
        z_m=0.0,
    )
    difference_mps2 = (
        volts(slow, spin) - volts(nominal('xyz', **CLEAN, rc_capacitance_f=0.0), spin)
    ) * G
    assert difference_mps2[1000, 1] == pytest.approx(0.1 * growth, rel=1e-6)


@pytest.mark.parametrize(('frequency_hz', 'share'), [(0.2, 0.0), (20.0, 1.0)])
def test_vibration_rectification_follows_the_mean_square_but_no_slow_move(frequency_hz, share):
    time_s = np.arange(0.0, 20.0, 1e-3)
    force_mps2 = 0.3 * G * np.sin(2 * np.pi * frequency_hz * time_s)
    path = ForcePath(time_s, np.outer(force_mps2, [1.0, 0.0, 0.0]))
    moves = Motion(20.0, force=path, internal_rate_hz=1000.0)
    shaken = with_effect('vibration_rectification', coefficient_per_g=[0.1, 0.1, 0.1])
    shift_g = volts(shaken, moves) - volts(nominal('xyz', **CLEAN), moves)
    assert shift_g[1000:, 0].mean() == pytest.approx(share * 0.1 * 0.3**2 / 2, rel=0.1, abs=1e-5)


def test_thermal_lag_makes_the_zero_g_follow_a_slower_temperature():
    """With the slope of the zero-g, a step of temperature arrives by 1 − exp(−t/τ)."""
    step = Motion(300.0, internal_rate_hz=10.0, temperature_c=Steps(25.0, ((100.0, 35.0),), 0.01))
    plain = nominal(
        'x',
        **{key: CLEAN[key][:1] if np.ndim(CLEAN[key]) else CLEAN[key] for key in CLEAN},
        rate_hz=10.0,
    )
    bias, lag = with_effect('temperature_bias', plain), with_effect('thermal_lag', plain)
    both = replace(bias, effects=(*bias.effects, *lag.effects), values=bias.values | lag.values)
    moved_g = volts(both, step)[:, 0] - volts(plain, step)[:, 0]
    assert moved_g[990] == pytest.approx(0.0, abs=1e-12)
    assert moved_g[1600] == pytest.approx(1e-3 * (1 - np.exp(-1)), rel=1e-3)
    leads = put(both, [Coefficient('thermal_lag', 'per_k', 'x')], [-1e-4])
    assert (volts(leads, step) - volts(plain, step))[1005:1100].min() > 1.2e-3


def test_thermal_hysteresis_depends_on_the_direction_and_not_on_the_speed():
    """Warming at first adds nothing; far behind the reversal, cooling adds the width."""
    middles = []
    for seconds in (400.0, 40.0):
        cycle = Motion(
            seconds,
            internal_rate_hz=10.0,
            temperature_c=Knots([0, seconds / 2, seconds], [10.0, 60.0, 10.0]),
        )
        plain = nominal('xyz', **CLEAN, rate_hz=10.0)
        moved_v = (volts(with_effect('thermal_hysteresis', plain), cycle) - volts(plain, cycle))[
            :, 2
        ]
        middles += [moved_v[len(moved_v) // 4], moved_v[3 * len(moved_v) // 4]]
    assert middles == pytest.approx([0.0, 4e-3] * 2, abs=1e-9)


def test_flicker_is_one_over_f():
    """The density is k²/f within 3 % up to a fifth of the rate."""
    rest = Motion(4000.0, internal_rate_hz=10.0)
    densities = []
    for seed in range(3):
        sensor = with_effect('flicker', nominal('xyz', **CLEAN, rate_hz=100.0))
        data = volts(sensor, rest, seed)
        f, density = welch(data, 100.0, nperseg=2**16, axis=0, detrend=False)
        densities.append(density.mean(axis=1))
    shape = np.mean(densities, axis=0) * f / 1e-8
    for low, tolerance in ((0.03, 0.15), (0.3, 0.05), (2.0, 0.03), (6.0, 0.03)):
        assert shape[(f > low) & (f < 2 * low)].mean() == pytest.approx(1.0, abs=tolerance)
    f, response = sosfreqz(flicker_filter(100.0), [0.001, 0.02, 0.1, 0.7, 3.0, 9.0, 19.0], fs=100)
    assert 2 / 100 * f * abs(response) ** 2 == pytest.approx(np.ones(7), abs=0.03)


def test_bias_walks_with_the_root_of_time():
    """After the time t the variance over units is k²·t."""
    sensor = with_effect('bias_walk', nominal('xyz', **CLEAN, rate_hz=100.0))
    final_v = [
        volts(sensor, Motion(50.0, internal_rate_hz=10.0), seed)[-1] - [2.5, 2.5, 3.5]
        for seed in range(150)
    ]
    assert np.std(final_v) == pytest.approx(2e-5 * np.sqrt(50), rel=0.1)


def test_inverse_uses_temperature_supply_and_time():
    names = [n for n in NAMES if library()[n].invertible and Need.STAGE not in library()[n].needs]
    sensor = with_neutral(nominal('xyz'), names)
    sensor = replace(sensor, values={n: typical(library()[n], 'xyz') for n in names})
    rng = np.random.default_rng(0)
    around = signal_chain.Environment(
        rng.uniform(0, 900, 400), rng.uniform(-20, 60, 400), rng.uniform(4.5, 5.5, 400)
    )
    truth = rng.normal(size=(3, 400)) * 5
    force = signal_chain.inverse(sensor)(
        signal_chain.static_response(sensor)(list(truth), around), around
    )
    np.testing.assert_allclose(np.array(force), truth, atol=1e-9 * G)


@pytest.mark.parametrize(
    'name, changes, motion',
    [
        ('quantisation', {'adc_bits': 0}, MOTION),
        ('noise_excess', {'noise_density_g_per_rthz': np.zeros(3)}, MOTION),
        ('backlash', {}, Motion(1.0, force=lambda at_s: [0 * at_s] * 3)),
    ],
)
def test_an_effect_without_its_stage_of_the_chain_is_refused(name, changes, motion):
    with pytest.raises(UserError, match=f'^{name} acts on the '):
        Response(replace(with_effect(name, nominal('xyz')), **changes), motion, 0)
