# SPDX-License-Identifier: Apache-2.0

"""Each effect: neutral values change nothing, blocks join, tangents agree, closed forms hold."""

from dataclasses import replace
from functools import cache

from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.coefficients import (
    get,
    names_of,
    neutral,
    parameter_of,
    put,
    typical,
    with_neutral,
)
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import ActsOn, Coefficient, Need, NOMINAL_ENVIRONMENT, Place
from adxl_ros.model.filters import low_pass, resonator
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.play_operator import play
from adxl_ros.simulate.motion import Held, Knots, Motion
from adxl_ros.simulate.response import Response
from adxl_ros.simulate.simulator import simulate
from adxl_ros.simulate.smoothed_paths import ForcePath
from adxl_ros.simulate.trajectories import Sine, Steps
import numpy as np
import pytest
from scipy.signal import welch
from units import Fed, nominal

G = 9.80665
NAMES = sorted(library())
CLEAN = {'noise_density_g_per_rthz': np.zeros(3), 'adc_bits': 0}
MOTION = Motion(12.0, Knots([0, 1, 3, 5, 7, 12], [0.5, 0.5, 1.2, 0.9, 2.0, 2.0]),
                Knots([0, 2, 4, 5, 12], [0, 0, 2, 1.5, 3]), Knots([0, 6, 7, 12], [0, 0, 0.02, 0]),
                temperature_c=Steps(25.0, ((2.0, 35.0), (7.0, 20.0)), 1.0),
                supply_v=Steps(5.0, ((4.0, 4.8),), 0.5))


_TIME_S = np.arange(0.0, 12.0, 0.01)
FOLLOWED = Motion(12.0, force=ForcePath(_TIME_S, G * np.column_stack([
    0.3 * np.sin(9 * _TIME_S), 0.4 * np.cos(5 * _TIME_S), 1 + 0.2 * np.sin(23 * _TIME_S)])),
    temperature_c=MOTION.temperature_c, supply_v=MOTION.supply_v)


def with_effect(name, sensor=None, **changes):
    """Return a sensor with one effect at its typical values, except for the changes."""
    sensor = sensor or nominal('xyz', **CLEAN)
    values = {**typical(library()[name], sensor.axes), **{k: np.asarray(v, float)
                                                          for k, v in changes.items()}}
    return replace(sensor, effects=(name,), values={name: values})


def motion_of(name):
    """Return a motion on which an effect acts: errors of a reference act on a recorded force."""
    return FOLLOWED if library()[name].place is Place.REFERENCE else MOTION


def volts(sensor, motion=None, seed=1):
    """Simulate a motion; return volts, (n, m)."""
    if motion is None:
        motion = motion_of(sensor.effects[0]) if sensor.effects else MOTION
    columns = simulate(sensor, motion, seed)
    return np.column_stack([columns[f'{axis}_v'] for axis in sensor.axes])


@pytest.fixture(scope='module')
def plain():
    """Give a function that returns volts without an effect, in its motion, with noise and ADC."""
    return cache(lambda name: volts(nominal('xyz'), motion_of(name)))


def test_the_library_has_the_documented_effects():
    """The library contains all effects on which other software relies."""
    names = ('bias scale_factor cross_axis scale_factor_z cross_axis_z misalignment '
             'nonlinearity quadratic hysteresis bandwidth mount_resonance temperature_bias '
             'temperature_scale warm_up bias_walk supply saturation quantisation adc_inl '
             'noise_excess flicker mains_hum spikes stuck vibration_rectification time_offset '
             'clock_skew gravity base_tilt stage_offset stage_eccentricity backlash lever_arm '
             'thermal_lag thermal_hysteresis reference_filter reference_delay reference_frame')
    listed = names.split()
    assert not set(listed) - set(NAMES)


@pytest.mark.parametrize('name', NAMES)
def test_neutral_is_identity_to_the_bit(name, plain):
    """An effect at its neutral values changes no bit of a noisy recording in motion."""
    np.testing.assert_array_equal(volts(with_neutral(nominal('xyz'), [name])), plain(name))


@pytest.mark.parametrize('name', NAMES)
def test_typical_values_change_a_recording_and_blocks_join(name, plain):
    """A typical effect changes the volts, equally in one block and in many."""
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


@pytest.mark.parametrize('axes', ['x', 'xy', 'xyz'])
@pytest.mark.parametrize('name', NAMES)
def test_an_effect_acts_on_every_axis_of_the_sensor(name, axes):
    """A typical effect changes each axis of a sensor with one, two or three."""
    sensor = nominal(axes)
    plain_v = volts(sensor, motion_of(name))
    events = {'spikes': {'rate_hz': 20.0}, 'stuck': {'rate_hz': 3.0},
              'saturation': {'limit_g': [0.3] * len(axes)}}
    with_typical_v = volts(with_effect(name, sensor, **events.get(name, {})))
    assert np.all(np.abs(with_typical_v - plain_v).max(axis=0) > 1e-5)


@pytest.mark.parametrize('name', [n for n in NAMES if library()[n].smooth
                                  and library()[n].acts_on is ActsOn.MEAN])
def test_tangents_do_not_depend_on_the_step(name):
    """Finite differences of smooth effects with two steps agree."""
    sensor = with_effect(name)
    for coefficient in names_of(library()[name], 'xyz'):
        value, scale = get(sensor, [coefficient])[0], parameter_of(coefficient).scale
        slopes = [(volts(put(sensor, [coefficient], [value + step]))
                   - volts(put(sensor, [coefficient], [value - step]))) / (2 * step)
                  for step in (1e-3 * scale, 2e-4 * scale)]
        size = np.abs(slopes[0]).max()
        assert np.abs(slopes[0] - slopes[1]).max() <= 2e-3 * size + 1e-9 / scale


@pytest.mark.parametrize('name', NAMES)
def test_bounds_contain_neutral_and_typical_values(name):
    """Every parameter states its unit and source, every effect its cause."""
    effect = library()[name]
    assert effect.cause.endswith('.')
    for p in effect.parameters:
        assert p.unit and p.source and p.doc and p.scale > 0
        for value in (p.neutral, p.scale if p.typical is None else p.typical):
            assert p.lower <= value <= p.upper


def test_filter_at_10_hz():
    """The RC filter of the paper has the gain 0.833 and the phase −33.6° at 10 Hz."""
    time_s = np.arange(4000) / 1000
    out = low_pass(np.sin(20 * np.pi * time_s), 32e3 * 0.33e-6, 1e-3, {})
    wave = 2j * (out * np.exp(-20j * np.pi * time_s))[2000:].mean()
    assert abs(wave) == pytest.approx(0.8333, abs=1e-4)
    assert np.degrees(np.angle(wave)) == pytest.approx(-33.56, abs=0.01)


def test_resonance():
    """At its natural frequency a resonator has the gain 1/(2·ζ) and a phase of −90°."""
    time_s = np.arange(20000) / 4000
    out = resonator(np.sin(2 * np.pi * 80 * time_s), 80.0, 0.05, 1 / 4000, {})
    wave = 2j * (out * np.exp(-2j * np.pi * 80 * time_s))[10000:].mean()
    assert abs(wave) == pytest.approx(10.0, rel=1e-4)
    assert np.degrees(np.angle(wave)) == pytest.approx(-90.0, abs=0.01)


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
    parts = [play(x[i:i + 61], 2, memory) for i in range(0, len(x), 61)]
    np.testing.assert_array_equal(np.concatenate(parts), expected)


def test_hysteresis_lags_by_its_half_width():
    """Far from a reversal the output lags by half the width of the loop, in both directions."""
    sweep = np.concatenate([np.linspace(-1, 1, 3000), np.linspace(1, -1, 3000)])
    sensor = with_effect('hysteresis', nominal('x', rc_capacitance_f=0.0, adc_bits=0,
                                               noise_density_g_per_rthz=np.zeros(1)))
    out = Fed(sensor)([sweep * G, 0.0, 0.0])[:, 0] - 2.5
    up, down = np.interp(0.0, sweep[:3000], out[:3000]), np.interp(0.0, sweep[:2999:-1],
                                                                   out[:2999:-1])
    assert (up, down) == pytest.approx((-2e-3, 2e-3), abs=1e-9)


def test_backlash_lags_by_half_of_its_width():
    """A turning joint lags its encoder by half of the dead band."""
    swing = Motion(8.0, Held(np.pi / 2), Knots([0, 3, 4, 7, 8], [0, 2, 2, 0, 0]))
    difference_v = (volts(with_effect('backlash', beta_rad=4e-3), swing)
                    - volts(nominal('xyz', **CLEAN), swing))
    # At beta = 2 and at beta = 0 of alpha 90°: df_x = −sin(beta)·d beta·g.
    assert difference_v[3900, 0] == pytest.approx(-np.sin(2.0) * -2e-3, rel=2e-3)
    assert difference_v[-1, 1] == pytest.approx(-2e-3, rel=1e-3)


def test_lever_arm_is_centripetal_and_tangential():
    """The force is ω²·r towards the axis, and ω̇·r across it while the speed grows."""
    spin = Motion(9.0, Held(0.0), Knots([0, 2, 8, 9], [0, 3, 21, 22.5], [0, 3, 3, 0]))
    difference_mps2 = (volts(with_effect('lever_arm', x_m=0.1, y_m=0.0, z_m=0.0), spin)
                       - volts(nominal('xyz', **CLEAN), spin)) * G
    assert difference_mps2[5000] == pytest.approx([-0.9, 0.0, 0.0], abs=1e-6)
    growth = spin.beta(np.array([1.0]), 2)[0]
    assert growth > 1.0
    slow = with_effect('lever_arm', nominal('xyz', **{**CLEAN, 'rc_capacitance_f': 0.0}),
                       x_m=0.1, y_m=0.0, z_m=0.0)
    difference_mps2 = (volts(slow, spin)
                       - volts(nominal('xyz', **CLEAN, rc_capacitance_f=0.0), spin)) * G
    assert difference_mps2[1000, 1] == pytest.approx(0.1 * growth, rel=1e-6)


def test_supply_effect_has_the_values_of_the_datasheet():
    """The ADXL203 gives 560 mV/g and 1.5 V at 3 V."""
    respond = signal_chain.static_response(with_effect('supply'))
    around = NOMINAL_ENVIRONMENT._replace(supply_v=3.0)
    at_zero_v, at_1_g_v = (respond([f, 0.0, 0.0], around)[0] for f in (0.0, G))
    assert at_zero_v == pytest.approx(1.5, abs=1e-12)
    assert at_1_g_v - at_zero_v == pytest.approx(0.560, abs=2e-4)


def test_temperature_moves_zero_g_and_scale():
    """Zero-g changes by 0.1 mg/K from 25 °C on, and the scale factor by its coefficient."""
    around = NOMINAL_ENVIRONMENT._replace(temperature_c=35.0)
    bias, scale = (signal_chain.static_response(with_effect(name))
                   for name in ('temperature_bias', 'temperature_scale'))
    assert bias([0.0, 0.0, 0.0], around)[0] == pytest.approx(2.501, abs=1e-12)
    assert scale([G, 0.0, 0.0], around)[0] == pytest.approx(3.501, abs=1e-12)


def test_thermal_lag_makes_the_zero_g_follow_a_slower_temperature():
    """With the slope of the zero-g, a step of temperature arrives by 1 − exp(−t/τ)."""
    step = Motion(300.0, internal_rate_hz=10.0, temperature_c=Steps(25.0, ((100.0, 35.0),), 0.01))
    plain = nominal('x', **{key: CLEAN[key][:1] if np.ndim(CLEAN[key]) else CLEAN[key]
                            for key in CLEAN}, rate_hz=10.0)
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
        cycle = Motion(seconds, internal_rate_hz=10.0, temperature_c=Knots(
            [0, seconds / 2, seconds], [10.0, 60.0, 10.0]))
        plain = nominal('xyz', **CLEAN, rate_hz=10.0)
        moved_v = (volts(with_effect('thermal_hysteresis', plain), cycle)
                   - volts(plain, cycle))[:, 2]
        middles += [moved_v[len(moved_v) // 4], moved_v[3 * len(moved_v) // 4]]
    assert middles == pytest.approx([0.0, 4e-3] * 2, abs=1e-9)


def test_vibration_shifts_by_its_mean_square():
    """A vibration of 1 m/s² at 40 Hz shifts the zero-g by k·a²/2."""
    shake = Motion(12.0, Held(np.pi / 2), Held(np.pi / 2), Sine(1 / (80 * np.pi) ** 2, 40.0))
    difference_v = (volts(with_effect('vibration_rectification'), shake)
                    - volts(nominal('xyz', **CLEAN), shake))
    assert difference_v[-4000:, 0].mean() == pytest.approx(0.05 * (1 / G) ** 2 / 2, rel=1e-3)


def test_variance_of_quantisation_follows_from_its_step():
    """Rounding a slow ramp has the variance LSB²/12 of the remaining bits."""
    sensor = nominal('x', noise_density_g_per_rthz=np.zeros(1))
    ramp = [np.linspace(0, 1, 60000) * G, 0.0, 0.0]
    exact = Fed(replace(sensor, adc_bits=0))(ramp)
    for lost in (0, 3):
        coarse = Fed(with_effect('quantisation', sensor, lost_bits=lost))(ramp)
        lsb = sensor.lsb_v * 2 ** lost
        assert np.var(coarse - exact) == pytest.approx(lsb ** 2 / 12, rel=0.01)


def test_one_axis_may_have_coarser_codes_than_the_others():
    """Bits that an axis loses add to those that all lose."""
    sensor = with_effect('quantisation', nominal('xyz'), lost_bits=1, axis_lost_bits=[0, 3, 0])
    steps = volts(sensor) / sensor.lsb_v
    assert [np.gcd.reduce(np.rint(axis).astype(int)) for axis in steps.T] == [2, 16, 2]


def test_flicker_is_one_over_f():
    """The density is k²/f within 2 % up to a fifth of the rate, in theory and in a simulation."""
    rest = Motion(4000.0, internal_rate_hz=10.0)
    densities = []
    for seed in range(3):
        sensor = with_effect('flicker', nominal('xyz', **CLEAN, rate_hz=100.0))
        data = volts(sensor, rest, seed)
        f, density = welch(data, 100.0, nperseg=2 ** 16, axis=0, detrend=False)
        densities.append(density.mean(axis=1))
    shape = np.mean(densities, axis=0) * f / 1e-8
    for low, tolerance in ((0.03, 0.15), (0.3, 0.05), (2.0, 0.03), (6.0, 0.03)):
        assert shape[(f > low) & (f < 2 * low)].mean() == pytest.approx(1.0, abs=tolerance)
    corners = np.array([0.001, 0.02, 0.1, 0.7, 3.0, 9.0, 19.0])
    assert flicker_theory(corners, 100.0) == pytest.approx(np.ones(7), abs=0.02)


def test_flicker_is_stationary_from_the_first_sample_on():
    """Over many units, the first second has the covariance of the sampled processes."""
    from adxl_ros.model.effects.flicker import corners_hz
    sensor = with_effect('flicker', nominal('xyz', **CLEAN, rate_hz=100.0),
                         density_g_per_rthz=[1e-4] * 3)
    rest = Motion(1.0, internal_rate_hz=10.0)
    still_v = nominal('xyz').nominal_zero_g_v + [0, 0, nominal('xyz').nominal_scale_v_per_g[2]]
    drawn = np.stack([volts(sensor, rest, seed) - still_v for seed in range(500)])
    drawn = drawn[:, [0, 1, 10, 99]] / (1e-4 * sensor.nominal_scale_v_per_g)
    measured = np.einsum('uid,ujd->ij', drawn, drawn) / (3 * len(drawn))
    lag = np.abs(np.subtract.outer([0, 1, 10, 99], [0, 1, 10, 99]))
    decay = np.exp(-2 * np.pi * corners_hz(100.0) / 100.0)[:, None, None]
    assert measured == pytest.approx(np.log(10) / 2 * np.sum(decay ** lag, axis=0), rel=0.12)


def flicker_theory(f, rate_hz):
    """Return f times the sum of the densities of the sampled processes, for k = 1."""
    from adxl_ros.model.effects.flicker import corners_hz
    a = np.exp(-2 * np.pi * corners_hz(rate_hz) / rate_hz)[:, None]
    step = np.log(10) / 2
    each = 2 / rate_hz * (1 - a * a) / (1 - 2 * a * np.cos(2 * np.pi * f / rate_hz) + a * a)
    return f * step * each.sum(axis=0)


def test_bias_walks_with_the_root_of_time():
    """After the time t the variance over units is k²·t."""
    sensor = with_effect('bias_walk', nominal('xyz', **CLEAN, rate_hz=100.0))
    final_v = [volts(sensor, Motion(50.0, internal_rate_hz=10.0), seed)[-1] - [2.5, 2.5, 3.5]
               for seed in range(150)]
    assert np.std(final_v) == pytest.approx(2e-5 * np.sqrt(50), rel=0.1)


def test_a_walk_that_returns_ends_in_bounds():
    """Its rms is k/√(2·r), and its steps are those of the walk without bounds."""
    sensor = put(with_effect('bias_walk', nominal('xyz', **CLEAN, rate_hz=10.0)),
                 [Coefficient('bias_walk', 'return_per_s')], [0.1])
    out_v = volts(sensor, Motion(10000.0, internal_rate_hz=10.0))[1000:] - [2.5, 2.5, 3.5]
    assert np.std(out_v, axis=0) == pytest.approx(np.full(3, 2e-5 / np.sqrt(0.2)), rel=0.1)
    assert np.std(np.diff(out_v, axis=0)) == pytest.approx(2e-5 * np.sqrt(0.1), rel=0.02)


def test_time_offset_and_clock_skew_shift_the_samples():
    """With a positive offset and skew, a sample was taken before its stamp."""
    ramp = Motion(20.0, Held(np.pi / 2), Knots([0, 1, 19, 20], [0, .05, 1.85, 1.9],
                                               [0, 0.1, 0.1, 0]))
    clean = volts(nominal('xyz', **CLEAN), ramp)[:, 1]
    late = volts(with_effect('time_offset', offset_s=0.02), ramp)[:, 1]
    np.testing.assert_allclose(late[3020:15000], clean[3000:14980], atol=1e-12)
    skewed = volts(with_effect('clock_skew', ratio=1e-3), ramp)[:, 1]
    assert skewed[10000] == pytest.approx(clean[9990], abs=1e-7)


def test_inverse_uses_temperature_supply_and_time():
    """Given temperature, supply and time since power-on, the inverse is exact."""
    names = [n for n in NAMES if library()[n].invertible and Need.STAGE not in library()[n].needs]
    sensor = with_neutral(nominal('xyz'), names)
    sensor = replace(sensor, values={n: typical(library()[n], 'xyz') for n in names})
    rng = np.random.default_rng(0)
    around = signal_chain.Environment(rng.uniform(0, 900, 400), rng.uniform(-20, 60, 400),
                                      rng.uniform(4.5, 5.5, 400))
    truth = rng.normal(size=(3, 400)) * 5
    force = signal_chain.inverse(sensor)(
        signal_chain.static_response(sensor)(list(truth), around), around)
    np.testing.assert_allclose(np.array(force), truth, atol=1e-9 * G)


def test_local_gravity_is_used_by_equation_5():
    """A two-axis sensor computes z from the corrected gravity."""
    sensor = with_effect('gravity', nominal('xy'))
    force = specific_force(0.6, 0.3, signal_chain.gravity_mps2(sensor))
    recovered = signal_chain.inverse(sensor)(
        signal_chain.static_response(sensor)([float(f) for f in force]))
    assert recovered == pytest.approx([float(f) for f in force], abs=1e-9)


@pytest.mark.parametrize('name, changes, motion', [
    ('quantisation', {'adc_bits': 0}, MOTION),
    ('noise_excess', {'noise_density_g_per_rthz': np.zeros(3)}, MOTION),
    ('backlash', {}, Motion(1.0, force=lambda at_s: [0 * at_s] * 3))])
def test_an_effect_without_its_stage_of_the_chain_is_refused(name, changes, motion):
    """The message names the effect if the sensor has no ADC, noise or stage."""
    with pytest.raises(UserError, match=f'^{name} acts on the '):
        Response(replace(with_effect(name, nominal('xyz')), **changes), motion, 0)


def test_neutral_values_are_stated_by_axis():
    """Values have one entry for each axis, or no axes."""
    values = neutral(library()['mount_resonance'], 'xy')
    assert values['gain'].tolist() == [0.0, 0.0] and values['frequency_hz'].shape == ()
