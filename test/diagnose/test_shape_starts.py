# SPDX-License-Identifier: Apache-2.0

"""Shapes are searched from several starts, so that no fit depends on one guess."""

from dataclasses import replace

from adxl_ros.diagnose.comparison import compare
from adxl_ros.diagnose.hypothesis_fit import fit_hypothesis
from adxl_ros.diagnose.linear_model import build_linear_model
from adxl_ros.diagnose.sensitivities import shapes, variants
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model.coefficients import with_neutral
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Coefficient, Role
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate import simulator
from adxl_ros.simulate.trajectories import shaker, tumble
from adxl_ros.tools.effect_option import with_effects
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


def test_wrong_bits_are_differentiated_once():
    """They do not depend on the periods of the sine, and are a variant of their own."""
    sensor = nominal('xy')
    tried = list(variants(simulate, sensor, library()['adc_inl'], simulate(sensor), True))
    with_bits = [v for v in tried if Coefficient('adc_inl', 'third_bit_v') in v.names]
    assert len(with_bits) == 1
    assert not with_bits[0].shape
    assert all(Coefficient('adc_inl', 'cosine_v') in v.names for v in tried if v.shape)


def test_a_limit_of_one_axis_starts_without_clipping_the_others():
    """Where the linear model takes nothing of a limit, its fit begins beyond all samples."""
    sensor = nominal('xyz')
    tried = list(variants(simulate, sensor, library()['saturation'], simulate(sensor), True))
    names = [Coefficient('saturation', 'limit_g', axis) for axis in 'xyz']
    assert any(all(variant.limit_start[name] < 1.0 for name in names) for variant in tried)
    for variant in tried:
        first = variant.first_limits({names[2]: 0.9, names[0]: 0.02})
        assert first[names[2]] == variant.limit_start[names[2]]
        assert min(first[names[0]], first[names[1]]) > 1.05
        assert first[Coefficient('saturation', 'knee_g')] > 0
        assert first[Coefficient('saturation', 'offset_g', 'x')] == 0


def test_the_linear_model_finds_a_filter_that_is_40_times_slower():
    """The best start is next to it. A filter that no file states is free in every hypothesis."""
    sensor = replace(nominal('xyz'), rate_hz=250.0, rc_capacitance_f=5e-9)
    motion = shaker(np.random.default_rng(4))
    slower = with_effects(sensor, ['bandwidth:resistance_ratio=39'])
    columns = simulator.simulate(slower, motion, 1)
    recording = Recording('drawn', columns.pop('time_s'), columns, sensor_info(sensor))
    linear_model = build_linear_model([compare(recording, sensor)], only=['bandwidth'])
    tried = [i for i, v in enumerate(linear_model.variants) if v.effect == 'bandwidth']
    best = max(tried, key=lambda i: linear_model.fit_variants([i]).log_evidence)
    name = Coefficient('bandwidth', 'resistance_ratio', 'x')
    start = linear_model.variants[best]
    hypothesis = fit_hypothesis(linear_model, ['bandwidth'],
                                dict.fromkeys(start.names, start.step), {})
    assert dict(zip(hypothesis.names, hypothesis.linearised.values))[name] \
        == pytest.approx(39.0, rel=0.05)
    assert linear_model.tolerance(name) == 0.02
    unstated = replace(sensor, measured=('rc_resistance_ohm', 'rc_capacitance_f'))
    linear_model = build_linear_model([compare(recording, unstated)], only=['bandwidth'])
    assert linear_model.tolerance(name) > 1.0


def test_a_fit_reaches_a_period_far_from_its_start():
    """The start is a whole period of the phase off; the fit tries shapes between the starts."""
    sensor = replace(nominal('xyz'), rate_hz=100.0)
    motion = tumble(np.random.default_rng(4))
    columns = simulator.simulate(with_effects(
        sensor, ['adc_inl:amplitude_v=0.004,cosine_v=0.002,cycles=6.7']), motion, 1)
    time_s = columns.pop('time_s')
    comparison = compare(Recording('drawn', time_s, columns, sensor_info(sensor)), sensor)
    linear_model = build_linear_model([comparison], only=['adc_inl'])
    cycles = Coefficient('adc_inl', 'cycles')
    hypothesis = fit_hypothesis(linear_model, ['adc_inl'], {
        Coefficient('adc_inl', 'amplitude_v'): -0.003}, {cycles: 5.8})
    fitted = dict(zip(hypothesis.names, hypothesis.linearised.values))
    assert fitted[cycles] == pytest.approx(6.7, abs=0.05)
