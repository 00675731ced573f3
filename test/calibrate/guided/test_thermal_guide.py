# SPDX-License-Identifier: Apache-2.0

"""A calibration over temperature, from its samples to its file, without ROS."""

from dataclasses import replace
import re

from adxl_ros.calibrate.guided.screen_contents import CaptureSettings, StageMode
from adxl_ros.calibrate.guided.session import Session, SessionSettings
from adxl_ros.calibrate.guided.thermal_guide import ThermalSettings
from adxl_ros.files import parameter_file, sweep_journal
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Envelope, with_neutral
from adxl_ros.simulate.motion import Held, Motion
from adxl_ros.simulate.response import simulate
import numpy as np
import pytest
from units import nominal, with_effects

RATE_HZ = 10.0
UNIT = nominal('xyz', serial='S1', rate_hz=RATE_HZ)


class Ramp:
    """Straight lines between temperatures."""

    def __init__(self, times_s, values_c):
        self.times_s, self.values_c = times_s, values_c

    def __call__(self, time_s, order=0):
        return np.interp(time_s, self.times_s, self.values_c)


CYCLE = Ramp([0, 300, 360, 660, 720, 800, 860, 940], [5, 45, 45, 5, 5, 45, 45, 5])
"""Slow and fast, with a stay at each end."""


def base():
    names = tuple(Coefficient('bias', 'offset_v', axis) for axis in 'xyz')
    unit = with_neutral(UNIT, ['bias'])
    return replace(
        unit,
        model='linear',
        covariance_names=names,
        covariance=np.eye(3) * 1e-8,
        envelope=Envelope(temperature_c=(29.0, 31.0)),
        provenance={'id': 'abc'},
    )


@pytest.fixture
def begin(tmp_path):
    begun = []

    def begin(high_c=40.0):
        if begun:
            begun[-1].journal.close()
        settings = SessionSettings(
            'thermal',
            'full',
            (),
            0.1,
            0.01,
            0,
            CaptureSettings(1.0, 0.0035, 20.0, StageMode.MANUAL),
            tmp_path / 'unit.yaml',
            tmp_path / 'journal',
            '',
            '',
            ThermalSettings((10.0, high_c), 4.0),
        )
        begun.append(Session(UNIT, settings, False, base()))
        return begun[-1]

    yield begin
    begun[-1].journal.close()


def recorded(*effects, seconds=940.0):
    """Simulate the resting unit; return stamps, ns, volts and temperatures."""
    motion = Motion(seconds, Held(0.7), Held(0.4), temperature_c=CYCLE, internal_rate_hz=RATE_HZ)
    columns = simulate(with_effects(UNIT, list(effects)), motion, 4)
    return (
        np.round(columns['time_s'] * 1e9).astype(np.int64) + 10**18,
        np.column_stack([columns[f'{axis}_v'] for axis in 'xyz']),
        columns['temperature_c'],
    )


def play(session, stamps_ns, volts, temperatures_c):
    for first in range(0, len(stamps_ns), 20):
        part = slice(first, first + 20)
        readings = session.guide.readings['temperature']
        for stamp_ns, value in zip(stamps_ns[part], temperatures_c[part]):
            readings.add(int(stamp_ns), float(value))
        session.feed(stamps_ns[part], volts[part])
        list(session.take_poses())
        if session.guide.next_pose() is None:
            return


def test_the_range_is_covered_in_both_directions_and_the_file_has_the_slopes(begin):
    session = begin()
    assert session.guide.destination() == 'warm it from 10 to 40 °C'
    assert session.guide.estimated()[0][1].text == 'not known yet over 10 to 40 °C'
    play(session, *recorded('temperature_bias:per_k=4e-4'))
    assert session.guide.next_pose() is None
    (coverage, error), _ = session.guide.estimated()
    expected_mg = re.match(r'zero-g ([\d.]+) mg expected over 10 to 40 °C', error.text)
    assert 0 < float(expected_mg[1]) < 0.5
    assert coverage.text == 'warming 10/10, cooling 10/10'
    fitted = session.finish().fitted
    assert fitted.effects == ('bias', 'temperature_bias')
    slopes = fitted.values['temperature_bias']['per_k']
    std = np.sqrt(np.diag(fitted.covariance))[3::2]
    assert np.all(np.abs(slopes - 4e-4) < 4 * std) and np.all(std < 2e-5)
    # At 30 °C, 5 K above the datasheet's temperature, the file gives the zero-g as before.
    shift_v = fitted.values['bias']['offset_v'] + fitted.scale_v_per_g * (
        5 * slopes + 25 * fitted.values['temperature_bias']['per_k2']
    )
    np.testing.assert_allclose(shift_v, 0.0, atol=1e-12)
    assert fitted.provenance['base'] == 'abc'
    assert parameter_file.load(session.settings.output).effects == fitted.effects


@pytest.mark.parametrize(
    'option, parameter, value',
    [
        ('thermal_lag:per_k=4e-4,tau_s=20', 'tau_s', 20.0),
        ('thermal_hysteresis:half_width_g=3e-3,reach_k=4', 'reach_k', 4.0),
    ],
)
def test_a_loop_is_fitted_where_warming_and_cooling_differ(begin, option, parameter, value):
    session = begin(80.0)
    play(session, *recorded('temperature_bias:per_k=4e-4', option))
    fitted = session.finish().fitted
    name = option.split(':')[0]
    assert name in fitted.effects
    assert float(fitted.values[name][parameter]) == pytest.approx(value, rel=0.15)


def test_an_interrupted_calibration_keeps_its_blocks(begin):
    session = begin()
    stamps_ns, volts, temperatures_c = recorded('temperature_bias:per_k=4e-4', seconds=200.0)
    play(session, stamps_ns, volts, temperatures_c)
    count = session.accepted_count
    assert count > 30
    written = sweep_journal.accepted_poses(sweep_journal.read(session.settings.journal).entries)
    assert len(written) == count
    resumed = begin()
    assert resumed.resumed == resumed.accepted_count == count
    assert resumed.guide.destination() == session.guide.destination()
