# SPDX-License-Identifier: Apache-2.0

"""Shapes are searched from several starts, so that no fit depends on one guess."""

from dataclasses import replace

from adxl_ros.diagnose.sensitivities import shapes, variants
from adxl_ros.model.coefficients import with_neutral
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Role
from adxl_ros.model.sensor import Sensor
import numpy as np
import pytest
from units import Fed, nominal

G = 9.80665


@pytest.mark.parametrize('effect', library().values(), ids=lambda effect: effect.name)
def test_starts_belong_to_shapes_and_lie_within_their_bounds(effect):
    """Starts rise, and every combination is tried."""
    tried = shapes(effect)
    for p in effect.parameters:
        assert not p.starts or p.role is Role.SHAPE or p.is_size
        assert list(p.starts) == sorted(set(p.starts))
        if p.role is Role.SHAPE and not p.held:
            values = {shape[p.name] for shape in tried}
            assert values.issuperset(p.starts)
            assert all(p.lower <= value <= p.upper for value in values)
    assert len({tuple(shape.items()) for shape in tried}) == len(tried)


def simulate(sensor: Sensor) -> np.ndarray:
    """Return the volts of a sensor that turns slowly through 1 g of either sign, (n, m)."""
    turn = np.linspace(0, 4 * np.pi, 3000)
    quiet = replace(sensor, noise_density_g_per_rthz=np.zeros(len(sensor.axes)), adc_bits=0)
    return Fed(quiet)([G * np.sin(turn), G * np.cos(turn), G * np.sin(turn + 1)])


@pytest.mark.parametrize('cycles', [1.7, 5.3, 10.2, 17.8, 29.0])
@pytest.mark.parametrize('phase', [0.0, 1.6])
def test_a_start_is_near_any_period_and_phase_of_a_converter(cycles, phase):
    """Some start explains most of a sine of any period, so that a fit reaches it."""
    sensor = nominal('xyz')
    baseline_v = simulate(sensor)
    with_curve = with_neutral(sensor, ['adc_inl'])
    values = {**with_curve.values['adc_inl'], 'cycles': np.array(cycles),
              'amplitude_v': np.array(1e-3 * np.cos(phase)),
              'cosine_v': np.array(1e-3 * np.sin(phase))}
    changed_v = simulate(replace(with_curve, values={'adc_inl': values})) - baseline_v
    changed_v -= changed_v.mean(axis=0)
    shares = []
    for variant in variants(simulate, sensor, library()['adc_inl'], baseline_v, True):
        columns = np.zeros((changed_v.size, len(variant.names) + 3))
        for d, axis in enumerate(variant.columns):
            rows = slice(d * len(changed_v), (d + 1) * len(changed_v))
            columns[rows, axis.numbers] = axis.values
            columns[rows, len(variant.names) + d] = 1.0
        target = changed_v.T.ravel()
        rest = target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0]
        shares.append(1 - float(rest @ rest) / float(target @ target))
    assert max(shares) > 0.5
