# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The inverse undoes the chain, and what it says of its own uncertainty is so."""

from dataclasses import replace

from adxl_ros.errors import UserError
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.coefficients import get, names_of, parameter_of, put, with_neutral
from adxl_ros.model.covariance import coefficient_tangent, force_covariance
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Coefficient, Need, Role
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


def one_of(axes: str, seed: int) -> Sensor:
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


def bits_off_v(sensor: Sensor) -> float:
    """Return by how much the wrong weights of bits can move volts, V."""
    return float(sum(abs(value) for name, value in sensor.values['adc_inl'].items()
                     if name.endswith('bit_v')))


def at_a_step(sensor: Sensor, force: np.ndarray) -> bool:
    """Tell whether the ADC's input is so near a step that another input may give its volts."""
    input_v = np.array(signal_chain.analog_response(sensor)([float(f) for f in force]))
    step_v = sensor.adc_vref_v / 64
    off_v = np.abs(input_v - np.rint(input_v / step_v) * step_v)
    return bool((off_v <= 2 * bits_off_v(sensor)).any())


@given(st.data(), st.sampled_from(AXES))
def test_inverse_undoes_the_chain(data: st.DataObject, axes: str) -> None:
    sensor = data.draw(sensors(axes))
    along = st.composite(direction)()
    force = data.draw(along) * {'x': 1.7, 'xy': 1.0, 'xyz': 1.7}[axes] * G
    if axes == 'x':
        force[1:] = 0
    if axes == 'xy':
        # Nearer to the plane, another z with the same volts may be the upper one.
        force[2] = abs(force[2]) + 0.4 * G
        force *= G / np.linalg.norm(force)
    volts = signal_chain.static_response(sensor)([float(f) for f in force])
    found = signal_chain.inverse(sensor)(volts)
    apart_mps2 = 4 * bits_off_v(sensor) * G if at_a_step(sensor, force) else 0.0
    np.testing.assert_allclose(found, force, rtol=0, atol=1e-9 + apart_mps2)
    many = signal_chain.inverse(sensor)([np.full(3, v) for v in volts])
    np.testing.assert_array_equal(np.array(many), np.array(found)[:, None] * np.ones(3))


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
    # Between two codes whose bits are off lies a gap that no force reaches.
    np.testing.assert_allclose(signal_chain.static_response(sensor)(force), volts, rtol=0,
                               atol=1e-6 + (bits_off_v(sensor) if sigmas else 0))
    # |f| is g; where noise puts more into the plane, it is the least that the volts allow.
    assert np.linalg.norm(force) > G - 1e-5


@pytest.mark.parametrize('bad', [np.nan, np.inf, 1e38, -1e300])
@pytest.mark.parametrize('axes', AXES)
def test_what_no_force_explains_is_nan_and_spoils_nothing(axes: str, bad: float) -> None:
    sensor = one_of(axes, 1)
    good = signal_chain.static_response(sensor)([1.0, 0.0, 0.0])
    volts = [np.array([v, bad, v]) for v in good]
    force = np.array(signal_chain.inverse(sensor)(volts))
    assert np.isnan(force[:, 1]).all() or not np.isfinite(bad) or np.abs(force[:, 1]).max() > 1e3
    alone = np.array(signal_chain.inverse(sensor)(good))
    np.testing.assert_array_equal(force[:, 0], alone)
    np.testing.assert_array_equal(force[:, 2], alone)


def test_z_sign_by_sample() -> None:
    sensor = one_of('xy', 2)
    alpha, beta = np.array([0.5, np.pi - 0.5]), np.array([1.0, 1.0])
    force = specific_force(alpha, beta, G)
    volts = signal_chain.static_response(sensor)(force)
    found = signal_chain.inverse(sensor, np.array([1, -1]))(volts)
    np.testing.assert_allclose(found, force, rtol=0, atol=1e-9)
    upside_down = signal_chain.inverse(replace(sensor, z_sign=-1))([float(v[1]) for v in volts])
    np.testing.assert_allclose(upside_down, [f[1] for f in force], rtol=0, atol=1e-9)


@pytest.mark.parametrize('axes', ['xy', 'xyz'])
def test_intervals_cover_what_they_promise(axes: str) -> None:
    """90 % intervals hold the truth in 88 to 92 % of units drawn from a calibration."""
    sensor = one_of(axes, 3)
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
    found = signal_chain.inverse(sensor)(list(volts))
    covariance = force_covariance(sensor, found)
    truth = np.tile(force, draws)
    for d in range(3):
        covered(found[d] - truth[d], np.sqrt(covariance[d, d]))
    shown = tilt(found, covariance, 'z' in axes)
    exact = tilt(list(truth), np.zeros((3, 3, truth.shape[1])))
    for name in ('roll', 'pitch', 'inclination', 'alpha', 'beta'):
        error = getattr(shown, name) - getattr(exact, name)
        covered((error + np.pi) % (2 * np.pi) - np.pi, getattr(shown, f'{name}_std'))


def covered(error: np.ndarray, std: np.ndarray) -> None:
    assert 0.88 < np.mean(np.abs(error) < 1.6449 * std) < 0.92


def test_coefficient_tangent_is_the_paper_s() -> None:
    """∂V/∂B = 1, ∂V/∂SF = A of equation 3."""
    sensor = replace(nominal(), effects=('bias', 'scale_factor'), values={
        'bias': {'offset_v': np.array([0.1, 0.0])},
        'scale_factor': {'offset_v_per_g': np.array([0.02, 0.0])}},
        covariance=np.eye(2) * 1e-6,
        covariance_names=(Coefficient('bias', 'offset_v', 'x'),
                          Coefficient('scale_factor', 'offset_v_per_g', 'x')))
    found = coefficient_tangent(sensor)([np.array([G / 2]), np.array([1.0]), np.array([0.0])])
    np.testing.assert_allclose(found[:, :, 0], [[1, 0.5], [0, 0]], atol=1e-9)


def test_vertical_z_scatters_as_promised() -> None:
    """At alpha = 90° z is the root of noise: √(0.8·σ·g), not infinite, and not zero."""
    sensor = nominal(adc_bits=0)
    rng = np.random.default_rng(6)
    volts = 2.5 + np.array([[1.0], [0.0]]) + rng.normal(size=(2, 50000)) * \
        noise.sample_std_v(sensor)[:, None]
    force = signal_chain.inverse(sensor)(list(volts))
    covariance = force_covariance(sensor, [np.array([v]) for v in (G, 0.0, 0.0)])
    assert np.sqrt(np.mean(force[2] ** 2)) == pytest.approx(np.sqrt(covariance[2, 2, 0]), rel=0.02)


def test_angles_of_known_poses() -> None:
    """REP-103 frames: pitched up by 30° x reads +g/2's opposite; rolled by 90° y reads g."""
    half, root = G / 2, G * 3 ** 0.5 / 2
    force = np.array([[-half, 0, root], [0, G, 0], [0, half, root], [half, -root, 0]]).T
    found = tilt(list(force), np.full((3, 3, 4), 1e-12) * np.eye(3)[:, :, None])
    np.testing.assert_allclose(np.degrees(found.pitch), [30, 0, 0, -30], atol=1e-9)
    np.testing.assert_allclose(np.degrees(found.roll), [0, 90, 30, -90], atol=1e-9)
    np.testing.assert_allclose(np.degrees(found.inclination), [30, 90, 30, 90], atol=1e-9)
    np.testing.assert_allclose(np.degrees(found.beta), [180, -90, -90, 60], atol=1e-9)


def test_what_a_pose_does_not_show() -> None:
    """Neither beta at alpha = 0, nor roll with x upright, nor anything in free fall."""
    spread = 1e-4 * np.eye(3)[:, :, None] * np.ones(3)
    found = tilt([np.array(c) for c in ([1e-3, G, 0.0], [0.0, 1e-3, 0.0], [G, 0.0, 0.0])], spread)
    for name, shown in (('beta', [False, True, False]), ('roll', [True, False, False]),
                        ('pitch', [True, True, False]), ('inclination', [True, True, False])):
        assert np.isfinite(getattr(found, name)).tolist() == shown
        assert np.isfinite(getattr(found, f'{name}_std')).tolist() == shown
    two_axes = tilt([np.array([3.0]), np.array([0.0]), np.array([-9.0])], spread[:, :, :1], False)
    assert two_axes.alpha == pytest.approx(np.arctan2(3, 9))


def test_floats_and_arrays_agree() -> None:
    """One formula serves a live sample and a recording."""
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


def test_roll_and_pitch_covary_as_by_differences() -> None:
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
        with_axes(one_of('xy', 1), 'xyz')
    uneven = nominal(nominal_scale_v_per_g=np.array([1.0, 0.9]))
    with pytest.raises(UserError, match=r'\[1.0, 0.9\] for xy does not determine'):
        with_axes(uneven, 'xyz')


def test_rails() -> None:
    sensor = nominal()
    low, high, inside, beyond = 0.0, 5.0 - 5.0 / 65536, 2.5, 7.0
    volts = np.array([[low, inside], [inside, high], [inside, inside], [beyond, inside]])
    assert signal_chain.at_a_rail(volts, sensor).tolist() == [True, True, False, False]
    assert not signal_chain.at_a_rail(volts, replace(sensor, adc_bits=0)).any()
