# SPDX-License-Identifier: Apache-2.0

"""The inverse undoes the chain, and its stated uncertainty is right."""

from dataclasses import replace

from adxl_ros.errors import UserError
from adxl_ros.model import analog_stages, noise, signal_chain
from adxl_ros.model.coefficients import get, names_of, parameter_of, put, with_neutral
from adxl_ros.model.covariance import coefficient_tangent, force_covariance, prepared_covariance
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import (
    Coefficient,
    Need,
    NOMINAL_ENVIRONMENT,
    Parameters,
    Place,
    Role,
    Signals,
)
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.scalar_or_array import ARRAYS, FLOATS
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.model.tilt import angles, roll_pitch_covariance, tilt
from hypothesis import given, strategies as st
import numpy as np
import pytest
from units import nominal

G = 9.80665
AXES = ('x', 'xy', 'xyz')


INVERTIBLE = tuple(name for name, effect in library().items()
                   if effect.invertible and Need.STAGE not in effect.needs)


@st.composite
def sensors(draw: st.DrawFn, axes: str) -> Sensor:
    """Draw a unit with every invertible effect of the library, within twice its typical size."""
    sensor = with_neutral(nominal(axes), INVERTIBLE)
    names = coefficients(sensor)
    return put(sensor, names, [
        parameter_of(n).scale * (
            1 if parameter_of(n).role is Role.SHAPE else draw(st.floats(-2, 2)))
        for n in names])


def coefficients(sensor: Sensor) -> tuple[Coefficient, ...]:
    return tuple(n for name in sensor.effects for n in names_of(library()[name], sensor.axes))


def drawn_sensor(axes: str, seed: int) -> Sensor:
    """Draw a unit at datasheet spread with a covariance of its coefficients."""
    rng = np.random.default_rng(seed)
    sensor = with_neutral(nominal(axes), INVERTIBLE)
    names = tuple(n for n in coefficients(sensor) if parameter_of(n).role is not Role.SHAPE)
    scale = np.array([parameter_of(n).scale for n in names])
    mixed = rng.normal(size=(len(names), len(names))) * 0.05 * scale[:, None] / len(names) ** 0.5
    return replace(put(sensor, names, rng.normal(size=len(names)) * scale),
                   covariance=mixed @ mixed.T, covariance_names=names)


def direction(draw: st.DrawFn) -> np.ndarray:
    vector = np.array([draw(st.floats(-1, 1)) for _ in range(3)]) + [0, 0, 1e-3]
    return vector / np.linalg.norm(vector)


def bit_error_v(sensor: Sensor) -> float:
    """Return the largest effect of the wrong bit weights, V."""
    return float(sum(abs(value) for name, value in sensor.values['adc_inl'].items()
                     if name.endswith('bit_v')))


def near_a_step(sensor: Sensor, force: np.ndarray) -> bool:
    """Return whether the input of the ADC is so near a step that another input has its code."""
    input_v = np.array(analog_stages.analog_response(sensor)([float(f) for f in force]))
    step_v = sensor.adc_vref_v / 64
    off_v = np.abs(input_v - np.rint(input_v / step_v) * step_v)
    return bool((off_v <= 2 * bit_error_v(sensor)).any())


@given(st.data(), st.sampled_from(AXES))
def test_inverse_undoes_the_chain(data: st.DataObject, axes: str) -> None:
    sensor = data.draw(sensors(axes))
    along = st.composite(direction)()
    force = data.draw(along) * {'x': 1.7, 'xy': 1.0, 'xyz': 1.7}[axes] * G
    if axes == 'x':
        force[1:] = 0
    if axes == 'xy':
        # Nearer to the plane, another z with the same volts may be the upper solution.
        force[2] = abs(force[2]) + 0.4 * G
        force *= G / np.linalg.norm(force)
    volts = signal_chain.static_response(sensor)([float(f) for f in force])
    recovered = signal_chain.inverse(sensor)(volts)
    apart_mps2 = 4 * bit_error_v(sensor) * G if near_a_step(sensor, force) else 0.0
    np.testing.assert_allclose(recovered, force, rtol=0, atol=1e-9 + apart_mps2)
    many = signal_chain.inverse(sensor)([np.full(3, v) for v in volts])
    np.testing.assert_array_equal(np.array(many), np.array(recovered)[:, None] * np.ones(3))


@given(st.data(), st.floats(-1, 1), st.floats(-np.pi, np.pi), st.floats(-3, 3))
def test_inverse_holds_at_the_vertical(data: st.DataObject, tilted: float, beta: float,
                                       sigmas: float) -> None:
    """Near alpha = ±90°, with noise or without, a finite force explains the volts."""
    sensor = data.draw(sensors('xy'))
    alpha = np.pi / 2 + tilted ** 5
    volts = signal_chain.static_response(sensor)(
        [float(f) for f in specific_force(alpha, beta, G)])
    volts = [v + sigmas * 1e-3 for v in volts]
    force = signal_chain.inverse(sensor)(volts)
    assert np.isfinite(force).all()
    # Between two codes with wrong bit weights lies a gap that no force reaches.
    np.testing.assert_allclose(signal_chain.static_response(sensor)(force), volts, rtol=0,
                               atol=1e-6 + (bit_error_v(sensor) if sigmas else 0))
    # |f| is g. Where noise makes the force in the plane larger, |f| is the smallest possible one.
    assert np.linalg.norm(force) > G - 1e-5


@pytest.mark.parametrize('invalid_v', [np.nan, np.inf, 1e38, -1e300])
@pytest.mark.parametrize('axes', AXES)
def test_volts_without_a_solution_are_nan_and_change_no_other_sample(axes: str, invalid_v: float
                                                                     ) -> None:
    sensor = drawn_sensor(axes, 1)
    valid_v = signal_chain.static_response(sensor)([1.0, 0.0, 0.0])
    volts = [np.array([v, invalid_v, v]) for v in valid_v]
    force = np.array(signal_chain.inverse(sensor)(volts))
    assert (np.isnan(force[:, 1]).all() or not np.isfinite(invalid_v)
            or np.abs(force[:, 1]).max() > 1e3)
    single = np.array(signal_chain.inverse(sensor)(valid_v))
    np.testing.assert_array_equal(force[:, 0], single)
    np.testing.assert_array_equal(force[:, 2], single)


def test_z_sign_by_sample() -> None:
    sensor = drawn_sensor('xy', 2)
    alpha, beta = np.array([0.5, np.pi - 0.5]), np.array([1.0, 1.0])
    force = specific_force(alpha, beta, G)
    volts = signal_chain.static_response(sensor)(force)
    recovered = signal_chain.inverse(sensor, np.array([1, -1]))(volts)
    np.testing.assert_allclose(recovered, force, rtol=0, atol=1e-9)
    upside_down = signal_chain.inverse(replace(sensor, z_sign=-1))([float(v[1]) for v in volts])
    np.testing.assert_allclose(upside_down, [f[1] for f in force], rtol=0, atol=1e-9)


@pytest.mark.parametrize('axes', ['xy', 'xyz'])
def test_intervals_have_their_stated_coverage(axes: str) -> None:
    """90 % intervals contain the truth in 88 to 92 % of units drawn from a calibration."""
    sensor = drawn_sensor(axes, 3)
    rng = np.random.default_rng(4)
    beta = np.radians([-150, -60, 20, 80])
    force = np.array(specific_force(np.radians([35, 60, 25, 50]), beta, G))
    draws = 2000
    root = np.linalg.cholesky(sensor.covariance + 1e-30 * np.eye(len(sensor.covariance)))
    volts = []
    for _ in range(draws):
        drawn = get(sensor, sensor.covariance_names) + root @ rng.normal(size=len(root))
        volts.append(signal_chain.static_response(put(sensor, sensor.covariance_names, drawn))(
            list(force)))
    volts = np.array(volts) + noise.sample_std_v(sensor)[:, None] * rng.normal(
        size=(draws, len(axes), len(beta)))
    volts = np.moveaxis(volts, 1, 0).reshape(len(axes), -1)
    recovered = signal_chain.inverse(sensor)(list(volts))
    covariance = force_covariance(sensor, recovered)
    truth = np.tile(force, draws)
    for d in range(3):
        assert_coverage(recovered[d] - truth[d], np.sqrt(covariance[d, d]))
    angles = tilt(recovered, covariance, 'z' in axes)
    exact = tilt(list(truth), np.zeros((3, 3, truth.shape[1])))
    for name in ('roll', 'pitch', 'inclination', 'alpha', 'beta'):
        error = getattr(angles, name) - getattr(exact, name)
        assert_coverage((error + np.pi) % (2 * np.pi) - np.pi, getattr(angles, f'{name}_std'))


def assert_coverage(error: np.ndarray, std: np.ndarray) -> None:
    assert 0.88 < np.mean(np.abs(error) < 1.6449 * std) < 0.92


def test_coefficient_tangent_equals_the_paper() -> None:
    """∂V/∂B = 1, ∂V/∂SF = A of equation 3."""
    sensor = replace(nominal(), effects=('bias', 'scale_factor'), values={
        'bias': {'offset_v': np.array([0.1, 0.0])},
        'scale_factor': {'offset_v_per_g': np.array([0.02, 0.0])}},
        covariance=np.eye(2) * 1e-6,
        covariance_names=(Coefficient('bias', 'offset_v', 'x'),
                          Coefficient('scale_factor', 'offset_v_per_g', 'x')))
    tangent = coefficient_tangent(sensor)([np.array([G / 2]), np.array([1.0]), np.array([0.0])])
    np.testing.assert_allclose(tangent[:, :, 0], [[1, 0.5], [0, 0]], atol=1e-9)


def many_forces(axes: str, count: int = 3000) -> list[np.ndarray]:
    """Return forces all around; at rest and upright where z is derived, up to the vertical."""
    vectors = np.random.default_rng(12).normal(size=(3, count))
    force = G * vectors / np.linalg.norm(vectors, axis=0)
    return list(force if axes == 'xyz' else np.array([force[0], force[1], np.abs(force[2])]))


@pytest.mark.parametrize('axes', AXES)
@pytest.mark.parametrize('has_adc', [False, True])
def test_shared_parts_of_the_chain_change_no_derivative(axes: str, has_adc: bool) -> None:
    drawn = drawn_sensor(axes, 7)
    if not has_adc:
        kept = tuple(n for n in drawn.covariance_names if n.effect != 'adc_inl')
        drawn = replace(drawn, effects=tuple(e for e in drawn.effects if e != 'adc_inl'),
                        covariance=np.eye(len(kept)), covariance_names=kept)
    force = many_forces(axes)
    surroundings = NOMINAL_ENVIRONMENT._replace(
        temperature_c=np.linspace(0, 60, len(force[0])), time_s=np.arange(len(force[0])) * 1.0)
    by_coefficient = coefficient_tangent(drawn)
    many = by_coefficient(force, surroundings)
    few = np.concatenate([
        by_coefficient([f[part] for f in force], surroundings._replace(
            temperature_c=surroundings.temperature_c[part], time_s=surroundings.time_s[part]))
        for part in np.split(np.arange(len(force[0])), 6)], axis=2)
    scale = np.abs(few).max(axis=(0, 2), keepdims=True)
    assert many.shape == few.shape
    assert (np.abs(many - few) <= 1e-9 * scale).all()


def test_effects_that_break_the_contract_get_the_complete_chain(
        monkeypatch: pytest.MonkeyPatch) -> None:
    """An effect of the element that multiplies the output instead of adding to it."""
    def doubled(signals: Signals, p: Parameters) -> None:
        signals.output[0] = signals.output[0] * (2 + p['linear'][0])

    broken = replace(library()['cross_axis'], apply=doubled)
    monkeypatch.setitem(library(), 'cross_axis', broken)
    sensor = replace(drawn_sensor('xyz', 3), effects=('bias', 'scale_factor_z', 'cross_axis'))
    kept = tuple(n for n in sensor.covariance_names if n.effect in sensor.effects)
    sensor = replace(sensor, covariance=np.eye(len(kept)), covariance_names=kept)
    force = many_forces('xyz')
    assert library()['cross_axis'] is broken
    by_coefficient = coefficient_tangent(sensor)
    np.testing.assert_allclose(by_coefficient(force)[:, :, :9],
                               by_coefficient([f[:9] for f in force]), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize('axes', AXES)
def test_steps_with_one_tangent_lead_to_the_same_force(
        axes: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Including samples whose noise puts the in-plane force beyond g."""
    drawn = drawn_sensor(axes, 7)
    volts = signal_chain.static_response(drawn)(many_forces(axes))
    noisy = list(np.array(volts) + np.random.default_rng(3).normal(
        size=np.shape(volts)) * noise.sample_std_v(drawn)[:, None])
    quick = np.array(signal_chain.inverse(drawn)(noisy))
    monkeypatch.setattr(signal_chain, '_CHORD_STEPS', 0)
    newton = np.array(signal_chain.inverse(drawn)(noisy))
    np.testing.assert_allclose(quick, newton, rtol=0, atol=1e-9)


def of_effects(sensor: Sensor, effects: tuple[str, ...]) -> Sensor:
    """Return the sensor with some of its effects, and their coefficients."""
    kept = tuple(n for n in sensor.covariance_names if n.effect in effects)
    mixed = np.random.default_rng(4).normal(size=(len(kept), len(kept)))
    scale = np.array([parameter_of(name).scale for name in kept])
    return replace(sensor, effects=effects, covariance_names=kept,
                   covariance=1e-4 * mixed @ mixed.T * np.outer(scale, scale))


@pytest.mark.parametrize('axes', AXES)
@pytest.mark.parametrize('case', ['all', 'at rest', 'no polynomial', 'with force'])
def test_many_samples_get_the_force_and_covariance_of_few(
        axes: str, case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Polynomials replace the chain for many samples, if the effects are polynomials."""
    def rippled(signals: Signals, p: Parameters) -> None:
        for d, k in enumerate(p['quadratic_per_g']):
            signals.output[d] = signals.output[d] + k * np.sin(3 * signals.sensed[d])

    def following(signals: Signals, p: Parameters) -> None:
        for d, k in enumerate(p['quadratic_per_g']):
            signals.zero_g_v[d] = signals.zero_g_v[d] + k * signals.sensed[d] ** 2

    shapes = {'no polynomial': rippled, 'with force': following}
    if case in shapes:
        monkeypatch.setitem(library(), 'quadratic', replace(
            library()['quadratic'], apply=shapes[case],
            place=Place.ELEMENT if case == 'no polynomial' else Place.ELECTRONICS))
    drawn = drawn_sensor(axes, 7)
    sensor = of_effects(drawn, drawn.effects if case == 'all' else tuple(
        name for name in drawn.effects if name != 'adc_inl' and not library()[name].follows))
    volts = np.array(signal_chain.static_response(sensor)(many_forces(axes)))
    volts += np.random.default_rng(3).normal(size=volts.shape) * noise.sample_std_v(
        sensor)[:, None]
    count = volts.shape[1]
    surroundings = NOMINAL_ENVIRONMENT._replace(
        temperature_c=np.linspace(0, 60, count), time_s=np.arange(count) * 1.0)
    parts = [slice(begin, begin + 500) for begin in range(0, count, 500)]
    invert, covariance = signal_chain.inverse(sensor), prepared_covariance(sensor)
    around = [surroundings._replace(temperature_c=surroundings.temperature_c[part],
                                    time_s=surroundings.time_s[part]) for part in parts]
    few = np.hstack([invert(list(volts[:, part]), e) for part, e in zip(parts, around)])
    many = invert(list(volts), surroundings)
    # Where z is derived and 0, it is a root of rounding.
    np.testing.assert_allclose(many, few, rtol=0, atol=1e-9 if axes == 'xyz' else 1e-7)
    of_few = np.concatenate([covariance(list(few[:, part]), e)[0]
                             for part, e in zip(parts, around)], axis=2)
    of_many = covariance(list(few), surroundings)[0]
    scale = np.sqrt(np.einsum('iin,jjn->ijn', of_few, of_few))
    assert (np.abs(of_many - of_few) <= 1e-7 * scale).all()


def test_vertical_z_has_the_predicted_deviation() -> None:
    """At alpha = 90° the deviation of z is √(0.8·σ·g), neither infinite nor zero."""
    sensor = nominal(adc_bits=0)
    rng = np.random.default_rng(6)
    volts = 2.5 + np.array([[1.0], [0.0]]) + rng.normal(size=(2, 50000)) * \
        noise.sample_std_v(sensor)[:, None]
    force = signal_chain.inverse(sensor)(list(volts))
    covariance = force_covariance(sensor, [np.array([v]) for v in (G, 0.0, 0.0)])
    assert np.sqrt(np.mean(force[2] ** 2)) == pytest.approx(np.sqrt(covariance[2, 2, 0]), rel=0.02)


def test_angles_of_known_poses() -> None:
    """In frames of REP 103, x reads −g/2 at a pitch of 30°, and y reads g at a roll of 90°."""
    half, root = G / 2, G * 3 ** 0.5 / 2
    force = np.array([[-half, 0, root], [0, G, 0], [0, half, root], [half, -root, 0]]).T
    angles = tilt(list(force), np.full((3, 3, 4), 1e-12) * np.eye(3)[:, :, None])
    np.testing.assert_allclose(np.degrees(angles.pitch), [30, 0, 0, -30], atol=1e-9)
    np.testing.assert_allclose(np.degrees(angles.roll), [0, 90, 30, -90], atol=1e-9)
    np.testing.assert_allclose(np.degrees(angles.inclination), [30, 90, 30, 90], atol=1e-9)
    np.testing.assert_allclose(np.degrees(angles.beta), [180, -90, -90, 60], atol=1e-9)


def test_unobservable_angles_are_nan() -> None:
    """Beta at alpha = 0, roll with x upright, and all angles in free fall are unobservable."""
    spread = 1e-4 * np.eye(3)[:, :, None] * np.ones(3)
    angles = tilt([np.array(c) for c in ([1e-3, G, 0.0], [0.0, 1e-3, 0.0], [G, 0.0, 0.0])], spread)
    for name, observable in (('beta', [False, True, False]), ('roll', [True, False, False]),
                             ('pitch', [True, True, False]), ('inclination', [True, True, False])):
        assert np.isfinite(getattr(angles, name)).tolist() == observable
        assert np.isfinite(getattr(angles, f'{name}_std')).tolist() == observable
    two_axes = tilt([np.array([3.0]), np.array([0.0]), np.array([-9.0])], spread[:, :, :1], False)
    assert two_axes.alpha == pytest.approx(np.arctan2(3, 9))


def test_floats_and_arrays_agree() -> None:
    """The formulas give the same result for a live sample and for a recording."""
    rng = np.random.default_rng(7)
    force = rng.normal(size=(3, 200)) * 6
    mixed = rng.normal(size=(200, 3, 3)) * 0.1
    spread = np.array([(m @ m.T)[np.triu_indices(3)] for m in mixed]).T
    arrays = np.array([*np.array(angles(list(force), tuple(spread), ARRAYS)).reshape(8, -1),
                       roll_pitch_covariance(list(force), tuple(spread), ARRAYS)])
    for i in range(200):
        f, s = force[:, i].tolist(), tuple(spread[:, i].tolist())
        floats = [*np.ravel(angles(f, s, FLOATS)), roll_pitch_covariance(f, s, FLOATS)]
        np.testing.assert_allclose(floats, arrays[:, i], rtol=1e-12)


def test_covariance_of_roll_and_pitch_equals_finite_differences() -> None:
    force = np.array([3.0, -4.0, 8.0])
    spread = np.array([[4, 1, 2], [1, 5, -1], [2, -1, 6]]) * 1e-4

    def roll_pitch(f: np.ndarray) -> np.ndarray:
        return np.array([np.arctan2(f[1], f[2]), np.arctan2(-f[0], np.hypot(f[1], f[2]))])

    by = np.array([(roll_pitch(force + h) - roll_pitch(force - h)) / 2e-6
                   for h in 1e-6 * np.eye(3)]).T
    expected = by @ spread @ by.T
    six = tuple(spread[np.triu_indices(3)].tolist())
    (_, roll), (_, pitch), _, _ = angles(force.tolist(), six, FLOATS)
    assert [roll, pitch] == pytest.approx(np.diag(expected).tolist(), rel=1e-6)
    assert roll_pitch_covariance(force.tolist(), six, FLOATS) == pytest.approx(
        expected[0, 1], rel=1e-6)


def test_axes_of_a_nominal_sensor() -> None:
    assert with_axes(nominal(), 'xyz').nominal_zero_g_v.tolist() == [2.5, 2.5, 2.5]
    assert with_axes(nominal(), 'x').noise_density_g_per_rthz.shape == (1,)
    with pytest.raises(UserError, match='calibrated for the axes xy, not xyz'):
        with_axes(drawn_sensor('xy', 1), 'xyz')
    uneven = nominal(nominal_scale_v_per_g=np.array([1.0, 0.9]))
    with pytest.raises(UserError, match=r'\[1.0, 0.9\] for xy does not determine'):
        with_axes(uneven, 'xyz')


def test_rails() -> None:
    sensor = nominal()
    low, high, inside, beyond = 0.0, 5.0 - 5.0 / 65536, 2.5, 7.0
    volts = np.array([[low, inside], [inside, high], [inside, inside], [beyond, inside]])
    assert signal_chain.at_a_rail(volts, sensor).tolist() == [True, True, False, False]
    assert not signal_chain.at_a_rail(volts, replace(sensor, adc_bits=0)).any()
