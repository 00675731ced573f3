# SPDX-License-Identifier: Apache-2.0

"""The inverse undoes the chain, and its stated uncertainty is right."""

from dataclasses import replace

from adxl_ros.model import noise, signal_chain
from adxl_ros.model.covariance import coefficient_tangent, force_covariance
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import (
    ARRAYS,
    Coefficient,
    Environment,
    FLOATS,
    Maths,
    Need,
    Role,
)
from adxl_ros.model.kinematics import (
    angles,
    Covariance3,
    specific_force,
    tilt,
    turn_of_stage,
)
from adxl_ros.model.sensor import get, names_of, parameter_of, put, Sensor, with_neutral
from hypothesis import given, strategies as st
import numpy as np
import pytest
from units import nominal

G = 9.80665
AXES = ('x', 'xy', 'xyz')


INVERTIBLE = tuple(
    name
    for name, effect in library().items()
    if effect.invertible and Need.STAGE not in effect.needs
)


@st.composite
def sensors(draw: st.DrawFn, axes: str) -> Sensor:
    sensor = with_neutral(nominal(axes), INVERTIBLE)
    names = coefficients(sensor)
    return put(
        sensor,
        names,
        [
            parameter_of(n).scale
            * (1 if parameter_of(n).role is Role.SHAPE else draw(st.floats(-2, 2)))
            for n in names
        ],
    )


def coefficients(sensor: Sensor) -> tuple[Coefficient, ...]:
    return tuple(n for name in sensor.effects for n in names_of(library()[name], sensor.axes))


def drawn_sensor(axes: str, seed: int) -> Sensor:
    rng = np.random.default_rng(seed)
    sensor = with_neutral(nominal(axes), INVERTIBLE)
    names = tuple(n for n in coefficients(sensor) if parameter_of(n).role is not Role.SHAPE)
    scale = np.array([parameter_of(n).scale for n in names])
    mixed = rng.normal(size=(len(names), len(names))) * 0.05 * scale[:, None] / len(names) ** 0.5
    return replace(
        put(sensor, names, rng.normal(size=len(names)) * scale),
        covariance=mixed @ mixed.T,
        covariance_names=names,
    )


def direction(draw: st.DrawFn) -> np.ndarray:
    vector = np.array([draw(st.floats(-1, 1)) for _ in range(3)]) + [0, 0, 1e-3]
    return vector / np.linalg.norm(vector)


def bit_error_v(sensor: Sensor) -> float:
    """Return the largest effect of the wrong bit weights, V."""
    return float(
        sum(
            abs(value)
            for name, value in sensor.values['adc_inl'].items()
            if name.endswith('bit_v')
        )
    )


def near_a_step(sensor: Sensor, force: np.ndarray) -> bool:
    """Return whether the input of the ADC is so near a step that another input has its code."""
    input_v = np.array(signal_chain.analog_response(sensor)([float(f) for f in force]))
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


@pytest.mark.parametrize('invalid_v', [np.nan, np.inf, 1e38, -1e300])
@pytest.mark.parametrize('axes', AXES)
def test_volts_without_a_solution_are_nan_and_change_no_other_sample(
    axes: str, invalid_v: float
) -> None:
    sensor = drawn_sensor(axes, 1)
    valid_v = signal_chain.static_response(sensor)([1.0, 0.0, 0.0])
    volts = [np.array([v, invalid_v, v]) for v in valid_v]
    force = np.array(signal_chain.inverse(sensor)(volts))
    assert (
        np.isnan(force[:, 1]).all()
        or not np.isfinite(invalid_v)
        or np.abs(force[:, 1]).max() > 1e3
    )
    single = np.array(signal_chain.inverse(sensor)(valid_v))
    np.testing.assert_array_equal(force[:, 0], single)
    np.testing.assert_array_equal(force[:, 2], single)


@pytest.mark.parametrize('axes', ['xy', 'xyz'])
def test_intervals_have_their_stated_coverage(axes: str) -> None:
    sensor = drawn_sensor(axes, 3)
    rng = np.random.default_rng(4)
    beta = np.radians([-150, -60, 20, 80])
    force = np.array(specific_force(np.radians([35, 60, 25, 50]), beta, G))
    draws = 2000
    root = np.linalg.cholesky(sensor.covariance + 1e-30 * np.eye(len(sensor.covariance)))
    volts = []
    for _ in range(draws):
        drawn = get(sensor, sensor.covariance_names) + root @ rng.normal(size=len(root))
        volts.append(
            signal_chain.static_response(put(sensor, sensor.covariance_names, drawn))(list(force))
        )
    volts = np.array(volts) + noise.sample_std_v(sensor)[:, None] * rng.normal(
        size=(draws, len(axes), len(beta))
    )
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


@pytest.mark.parametrize('axes', AXES)
def test_derivatives_by_coefficients_are_those_of_the_whole_chain(axes: str) -> None:
    """Each begins at the place of its effect, and a parameter's axes share one difference."""
    sensor = drawn_sensor(axes, 5)
    rng = np.random.default_rng(6)
    force = list(rng.normal(size=(3, 50)) * 6)
    around = Environment(rng.uniform(0, 900, 50), rng.uniform(0, 50, 50), rng.uniform(4, 6, 50))
    slopes = coefficient_tangent(sensor)(force, around)
    for i, name in enumerate(sensor.covariance_names):
        step, value = 1e-3 * parameter_of(name).scale, get(sensor, [name])
        above, below = (
            np.array(
                signal_chain.static_response(put(sensor, [name], value + sign * step))(
                    force, around
                )
            )
            for sign in (1, -1)
        )
        expected = (above - below) / (2 * step)
        np.testing.assert_allclose(slopes[:, i], expected, atol=1e-8 * np.abs(expected).max())


def assert_coverage(error: np.ndarray, std: np.ndarray) -> None:
    assert 0.88 < np.mean(np.abs(error) < 1.6449 * std) < 0.92


def test_angles_of_known_poses() -> None:
    """In frames of REP 103, x reads −g/2 at a pitch of 30°, and y reads g at a roll of 90°."""
    half, root = G / 2, G * 3**0.5 / 2
    force = np.array([[-half, 0, root], [0, G, 0], [0, half, root], [half, -root, 0]]).T
    angles = tilt(list(force), np.full((3, 3, 4), 1e-12) * np.eye(3)[:, :, None])
    np.testing.assert_allclose(np.degrees(angles.pitch), [30, 0, 0, -30], atol=1e-9)
    np.testing.assert_allclose(np.degrees(angles.roll), [0, 90, 30, -90], atol=1e-9)
    np.testing.assert_allclose(np.degrees(angles.inclination), [30, 90, 30, 90], atol=1e-9)
    np.testing.assert_allclose(np.degrees(angles.beta), [180, -90, -90, 60], atol=1e-9)


def test_floats_and_arrays_agree() -> None:
    rng = np.random.default_rng(7)
    force = rng.normal(size=(3, 200)) * 6
    mixed = rng.normal(size=(200, 3, 3)) * 0.1
    spread = np.array([(m @ m.T)[np.triu_indices(3)] for m in mixed]).T
    by_array = every_angle(list(force), Covariance3(*spread), ARRAYS)
    for i in range(200):
        one = every_angle(force[:, i].tolist(), Covariance3(*spread[:, i].tolist()), FLOATS)
        np.testing.assert_allclose(one, by_array[:, i], rtol=1e-12)


def every_angle(force: list, covariance: Covariance3, maths: Maths) -> np.ndarray:
    estimates = (*angles(force, covariance, maths), turn_of_stage(force, covariance, maths))
    return np.array([number for estimate in estimates for number in estimate])
