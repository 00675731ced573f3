# SPDX-License-Identifier: Apache-2.0

"""The parameter file: round trips, and messages that name the place of a fault."""

from dataclasses import replace
from pathlib import Path
import re

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.model.sensor import Sensor
import numpy as np
import pytest
from units import drawn, nominal
import yaml

CALIBRATED = """/**:
  ros__parameters:
    format: 1
    units: 'V, V/g, 1/g, rad'
    model: linear
    sensor:
      serial: '17'
      axes: xy
      nominal_zero_g_v: [2.5, 2.5]
      nominal_scale_v_per_g: [1.0, 1.0]
      noise_density_g_per_rthz: [110.0e-6, 110.0e-6]
      rc_resistance_ohm: 32.0e+3
      rc_capacitance_f: 0.33e-6
      adc_bits: 16
      adc_vref_v: 5.0
      rate_hz: 1000.0
      range_g: 1.7
      local_gravity_mps2: 9.80665
      z_sign: 1
    stage:
      resolution_rad: 1.0e-3
    effects: [bias, scale_factor]
    bias:
      offset_v: [0.02, -0.03]
    scale_factor:
      offset_v_per_g: [0.01, 0.02]
    covariance_names: [bias.offset_v.x, bias.offset_v.y]
    covariance: [1.0e-6, 0.0, 0.0, 1.0e-6]
    provenance:
      date: '2026-01-01'
"""

BAD = {
    'not YAML': ('    effects: [bias', '    effects: [bias, {', r':\d+:\d+: not YAML: '),
    'a tab': ('      axes: xy', '\taxes: xy', r':8:1: not YAML: found character'),
    'an object': (
        "serial: '17'",
        'serial: !!python/object:os.system x',
        r':7:15: not YAML: could not determine a constructor',
    ),
    'no such key': (
        '      rate_hz: 1000.0\n',
        '',
        r':6:5: sensor.rate_hz: missing; it is the sample rate',
    ),
    'no coefficients': (
        '    scale_factor:\n      offset_v_per_g: [0.01, 0.02]\n',
        '',
        r':3:5: scale_factor.offset_v_per_g: missing',
    ),
    'unknown coefficient': (
        '      offset_v: [',
        '      drift: [0.0, 0.0]\n      offset_v: [',
        r':24:14: bias.drift: unknown parameter; bias has offset_v',
    ),
    'an int for a float': (
        'rate_hz: 1000.0',
        'rate_hz: 1000',
        r':16:16: sensor.rate_hz: 1000 is not a floating-point number; '
        r'write it with a point',
    ),
    'an int in an array': (
        'offset_v: [0.02, -0.03]',
        'offset_v: [0.02, 0]',
        r':24:17: bias.offset_v: 0 is not a floating-point number',
    ),
    'a float that YAML reads as text': (
        'rc_capacitance_f: 0.33e-6',
        'rc_capacitance_f: 1e-6',
        r":13:25: sensor.rc_capacitance_f: '1e-6' is not a "
        r'floating-point number; .* 1\.0e-6',
    ),
    'a float for an int': (
        'adc_bits: 16',
        'adc_bits: 16.0',
        r':14:17: sensor.adc_bits: 16.0 is not a whole number',
    ),
    'an int for text': ("serial: '17'", 'serial: 17', r':7:15: sensor.serial: 17 is not text'),
    'NaN': ('offset_v: [0.02,', 'offset_v: [.nan,', r':24:17: bias.offset_v: nan is not a finite'),
    'out of range': (
        'rate_hz: 1000.0',
        'rate_hz: -1.0',
        r':16:16: sensor.rate_hz: -1 Hz is outside 0.01 to 100000',
    ),
    'a coefficient out of range': (
        'offset_v: [0.02,',
        'offset_v: [20.0,',
        r':24:17: bias.offset_v: 20 V is outside -2 to 2',
    ),
    'another axis': ('axes: xy', 'axes: xz', r":8:13: sensor.axes: 'xz' is not one of x, xy, xyz"),
    'too few figures': (
        'nominal_zero_g_v: [2.5, 2.5]',
        'nominal_zero_g_v: [2.5]',
        r':9:25: sensor.nominal_zero_g_v: 1 values for 2 axes',
    ),
    'z_sign': ('z_sign: 1', 'z_sign: 2', r':19:15: sensor.z_sign: 2'),
    'unknown format': (
        'format: 1',
        'format: 7',
        r':3:13: format: version 7, but this package reads version 1',
    ),
    'no format': ('    format: 1\n', '', r':3:5: format: version None'),
    'other units': (
        "units: 'V, V/g, 1/g, rad'",
        "units: 'mV, mV/g'",
        r":4:12: units: 'mV, mV/g', but coefficients are in 'V, V/g, 1/g, rad'",
    ),
    'unknown effect': (
        'effects: [bias, scale_factor]',
        'effects: [bais, scale_factor]',
        r":22:14: effects: unknown effect 'bais'; known: ",
    ),
    'an effect twice': (
        'effects: [bias, scale_factor]',
        'effects: [bias, bias]',
        r':22:14: effects: a name stands twice',
    ),
    'no list of effects': (
        'effects: [bias, scale_factor]',
        'effects: bias',
        r":22:14: effects: 'bias' is not a list of names",
    ),
    'a key twice': (
        '    model: linear\n',
        '    model: linear\n    model: physical\n',
        r':6:5: model: stands twice; keep one',
    ),
    'a figure that is a tree': (
        'rate_hz: 1000.0',
        'rate_hz: {value: 1000.0}',
        r':16:7: sensor.rate_hz: missing',
    ),
    'unknown name in the covariance': (
        'bias.offset_v.y]',
        'bias.offset_v.z]',
        r":27:23: covariance_names: 'bias.offset_v.z' is no",
    ),
    'no covariance': (
        '    covariance: [1.0e-6, 0.0, 0.0, 1.0e-6]\n',
        '',
        r':3:5: covariance: missing; 2 names',
    ),
    'covariance of another size': (
        '[1.0e-6, 0.0, 0.0, 1.0e-6]',
        '[1.0e-6, 0.0, 0.0]',
        r':28:17: covariance: 3 values, but 2 names need 4',
    ),
    'covariance not symmetric': (
        '[1.0e-6, 0.0, 0.0, 1.0e-6]',
        '[1.0e-6, 5.0e-7, 0.0, 1.0e-6]',
        r':28:17: covariance: not symmetric and positive',
    ),
    'covariance not positive': (
        '[1.0e-6, 0.0, 0.0, 1.0e-6]',
        '[1.0e-6, 2.0e-6, 2.0e-6, 1.0e-6]',
        r':28:17: covariance: not symmetric and positive',
    ),
    'negative variance': (
        '[1.0e-6, 0.0, 0.0, 1.0e-6]',
        '[-1.0e-6, 0.0, 0.0, 1.0e-6]',
        r':28:17: covariance: not symmetric and positive',
    ),
    'no namespace': ('/**:', 'driver:', r":1:1: no '/\*\*' with parameters below it"),
    'no ros__parameters': ('ros__parameters:', 'parameters:', r":2:3: no 'ros__parameters'"),
}


def refusal(path: Path) -> str:
    with pytest.raises(UserError) as error:
        parameter_file.load(path)
    message = str(error.value)
    assert '\n' not in message
    assert message.startswith(f'{path}')
    return message.removeprefix(str(path))


@pytest.mark.parametrize('name', BAD)
def test_bad_file_is_refused_with_its_place(tmp_path: Path, name: str) -> None:
    right, wrong, message = BAD[name]
    assert right in CALIBRATED
    path = tmp_path / 'unit.yaml'
    path.write_text(CALIBRATED.replace(right, wrong, 1), encoding='utf-8')
    assert re.match(message, refusal(path)), refusal(path)


def assert_equal(first: Sensor, second: Sensor) -> None:
    assert parameter_file.to_flat(first) == parameter_file.to_flat(second)
    np.testing.assert_array_equal(first.covariance, second.covariance)


def test_round_trip(tmp_path: Path) -> None:
    (tmp_path / 'text.yaml').write_text(CALIBRATED, encoding='utf-8')
    sensor = parameter_file.load(tmp_path / 'text.yaml')
    assert sensor.zero_g_v.tolist() == [2.52, 2.47]
    assert sensor.provenance == {'date': '2026-01-01'}
    units = [
        sensor,
        drawn(np.random.default_rng(1), nominal('xyz')),
        replace(sensor, serial='007', provenance={'source': 'a: b # c', 'poses': '12'}),
    ]
    for unit in units:
        parameter_file.save(tmp_path / 'saved.yaml', unit, ['words: for', '/** people'])
        assert_equal(parameter_file.load(tmp_path / 'saved.yaml'), unit)


def test_saved_numbers_are_doubles_for_ros(tmp_path: Path) -> None:
    """Numbers such as 1e-06 and 1, which rcl reads as text or integer, have another form."""
    unit = nominal(rc_capacitance_f=1e-6, rate_hz=1.0, adc_vref_v=1e2)
    parameter_file.save(tmp_path / 'saved.yaml', unit)
    text = (tmp_path / 'saved.yaml').read_text(encoding='utf-8')
    for key in ('rc_capacitance_f', 'rate_hz', 'adc_vref_v'):
        assert re.search(rf'{key}: \d+\.\d+(e[-+]\d+)?$', text, re.MULTILINE)
    assert yaml.safe_load(text)['/**']['ros__parameters']['sensor']['adc_bits'] == 16


def test_failed_save_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / 'unit.yaml'
    parameter_file.save(path, nominal())
    before = path.read_bytes()
    with pytest.raises(ZeroDivisionError):
        parameter_file.save(path, nominal('x'), (str(1 / 0) for _ in 'x'))
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ['unit.yaml']
    with pytest.raises(UserError, match=f'{tmp_path}/none'):
        parameter_file.save(tmp_path / 'none' / 'unit.yaml', nominal())
