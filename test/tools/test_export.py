# SPDX-License-Identifier: Apache-2.0

"""A sensor in the formats of other software: each file is read by its reader and compared."""

from dataclasses import replace
import json
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

from adxl_ros.files import parameter_file
from adxl_ros.files.exports import FORMATS
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
import numpy as np
from processes import run_in_process
import pytest
from units import nominal
import yaml

COLUMNS = 79
ARM_M = (0.01, -0.02, 0.03)
OFFSET_V = np.array([0.03, -0.05])
MISALIGNED_RAD = 0.01
# Elements of SDFormat 1.9, noise.sdf.
NOISE_ELEMENTS = {'mean', 'stddev', 'bias_mean', 'bias_stddev', 'dynamic_bias_stddev',
                  'dynamic_bias_correlation_time', 'precision'}


def unit():
    """Return a sensor with effects that some formats hold and others do not."""
    return replace(
        nominal('xy'), serial='SN--7', effects=('bias', 'misalignment', 'lever_arm', 'bias_walk'),
        values={'bias': {'offset_v': OFFSET_V},
                'misalignment': {'alpha_rad': np.zeros(2), 'beta_rad': np.full(2, MISALIGNED_RAD)},
                'lever_arm': {f'{axis}_m': np.array(m) for axis, m in zip('xyz', ARM_M)},
                'bias_walk': {'density_g_per_rts': np.array([2e-5, 3e-5])}})


@pytest.fixture(scope='module')
def exported(tmp_path_factory):
    """Export the unit in all formats, and return the texts of the files and of the screens."""
    folder = tmp_path_factory.mktemp('export')
    parameter_file.save(folder / 'unit.yaml', unit())
    results = {}
    for name in FORMATS:
        done = run_in_process('export', 'unit.yaml', '--to', name, '-o', f'out.{name}', cwd=folder)
        assert done.returncode == 0, done.stderr
        path = folder / f'out.{name}'
        results[name] = SimpleNamespace(path=path, text=path.read_text(), screen=done.stdout)
    return results


def zero_g_mps2(sensor):
    return sensor.values['bias']['offset_v'] / sensor.nominal_scale_v_per_g * G0_MPS2


def test_the_formats_are_there():
    assert set(FORMATS) == {'broadcaster', 'isaaclab', 'json', 'kalibr', 'mujoco', 'sdf'}


@pytest.mark.parametrize('name', ['broadcaster', 'isaaclab', 'kalibr', 'mujoco', 'sdf'])
def test_the_head_says_what_the_format_cannot_hold(exported, name):
    """The size is that of the effect: an angle in mg, times the in-plane force across it."""
    lines = exported[name].text.splitlines()
    rows = [line.strip('# ').split() for line in lines]
    places = {row[0]: ' '.join(row[2:]) for row in rows if len(row) > 2}
    sizes = {row[0]: row[1] for row in rows if len(row) > 2}
    assert places['misalignment'] == 'not held'
    assert 0.2e3 * MISALIGNED_RAD < float(sizes['misalignment']) < 1e3 * MISALIGNED_RAD
    bias_mg = 1e3 * np.sqrt(np.mean((OFFSET_V / unit().nominal_scale_v_per_g) ** 2))
    assert float(sizes['bias']) == pytest.approx(bias_mg, rel=0.01)
    assert (places['bias'] == 'not held') == (name not in ('sdf', 'isaaclab'))
    assert 'no z' in exported[name].text
    assert max(map(len, exported[name].screen.splitlines())) <= COLUMNS


@pytest.mark.parametrize('name', ['isaaclab', 'sdf'])
def test_the_head_says_how_much_too_quiet_flat_noise_is(exported, name):
    frequency_hz = np.linspace(0, unit().rate_hz / 2, 20001)
    density = noise.density_v2_per_hz(replace(unit(), adc_bits=0), frequency_hz)[:, 0]
    text = ' '.join(line.strip('# ') for line in exported[name].text.splitlines())
    ratio = float(text.split('Its density is ')[1].split()[0])
    assert ratio == pytest.approx(np.sqrt(density[0] / density.mean()), rel=0.01)


def test_sdf(exported):
    """The zero-g is in the mean: gz-sensors draws the sign of bias_mean."""
    imu = ElementTree.fromstring(exported['sdf'].text).find('model/link/sensor')
    assert (imu.get('name'), imu.get('type')) == ('SN--7', 'imu')
    assert [float(v) for v in imu.find('pose').text.split()] == [*ARM_M, 0.0, 0.0, 0.0]
    assert float(imu.find('update_rate').text) == unit().rate_hz
    axes = imu.find('imu/linear_acceleration')
    assert [axis.tag for axis in axes] == ['x', 'y']
    for d, axis in enumerate(axes):
        element = axis.find('noise')
        assert element.get('type') == 'gaussian_quantized'
        values = {child.tag: float(child.text) for child in element}
        assert set(values) == NOISE_ELEMENTS
        scale = G0_MPS2 / unit().nominal_scale_v_per_g[d]
        assert values['mean'] == pytest.approx(zero_g_mps2(unit())[d])
        assert values['stddev'] == pytest.approx(noise.analog_std_v(unit())[d] * scale)
        assert values['precision'] == pytest.approx(unit().lsb_v * scale)
        walk = unit().values['bias_walk']['density_g_per_rts'][d] * G0_MPS2
        assert values['dynamic_bias_stddev'] == pytest.approx(walk)
        assert (values['bias_mean'], values['bias_stddev']) == (0.0, 0.0)


def test_mujoco(exported):
    mujoco = pytest.importorskip('mujoco', reason='mujoco is not installed: pip install mujoco')
    model = mujoco.MjModel.from_xml_path(str(exported['mujoco'].path))
    assert model.site('SN-7').pos == pytest.approx(ARM_M)
    assert model.sensor('SN-7').type[0] == mujoco.mjtSensor.mjSENS_ACCELEROMETER
    std_mps2 = noise.analog_std_v(unit()) / unit().nominal_scale_v_per_g * G0_MPS2
    assert model.sensor_noise[0] == pytest.approx(std_mps2.max())


def test_the_head_for_mujoco_runs(exported, monkeypatch):
    """The lines of Python in the head apply the whole chain to mjData."""
    mujoco = pytest.importorskip('mujoco', reason='mujoco is not installed: pip install mujoco')
    model = mujoco.MjModel.from_xml_path(str(exported['mujoco'].path))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    monkeypatch.chdir(exported['mujoco'].path.parent)
    lines = exported['mujoco'].text.split('after each mj_step:')[1].split('-->')[0]
    names = {'model': model, 'data': data}
    exec('\n'.join(line.strip() for line in lines.splitlines()), names)
    assert names['reading'][:2] == pytest.approx(zero_g_mps2(unit()), abs=0.3)


def test_isaaclab(exported, monkeypatch):
    """The module runs on configurations that have the fields of Isaac Lab."""
    class Offset(SimpleNamespace):

        def __init__(self, pos, rot=(1.0, 0.0, 0.0, 0.0)):
            super().__init__(pos=pos, rot=rot)

    class Noise(SimpleNamespace):

        def __init__(self, mean=0.0, std=1.0, operation='add'):
            super().__init__(mean=mean, std=std, operation=operation)

    contents = {'isaaclab': {}, 'isaaclab.utils': {}, 'torch': {'tensor': np.array},
                'isaaclab.sensors': {'ImuCfg': SimpleNamespace(OffsetCfg=Offset)},
                'isaaclab.utils.noise': {'GaussianNoiseCfg': Noise}}
    for name, members in contents.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(__import__('sys').modules, name, module)
    values = {}
    exec(compile(exported['isaaclab'].text, 'isaaclab.py', 'exec'), values)
    assert values['OFFSET'].pos == ARM_M
    assert values['UPDATE_PERIOD_S'] == pytest.approx(1 / unit().rate_hz)
    acceleration = values['ACCELERATION_NOISE']
    assert acceleration.operation == 'add'
    assert acceleration.mean == pytest.approx([*zero_g_mps2(unit()), 0.0])
    std_mps2 = noise.analog_std_v(unit()) / unit().nominal_scale_v_per_g * G0_MPS2
    assert acceleration.std == pytest.approx([*std_mps2, 0.0])


def test_kalibr(exported):
    """
    Kalibr reads these keys with PyYAML, and refuses values that are not positive floats.

    A sample of its noise has the variance N²·rate (ethz-asl/kalibr, wiki/IMU-Noise-Model), and
    white noise of the density d of a datasheet has d²·rate/2.
    """
    values = yaml.safe_load(exported['kalibr'].text)
    assert values == {
        'rostopic': '/imu/data_raw', 'update_rate': unit().rate_hz,
        'accelerometer_noise_density': pytest.approx(
            unit().noise_density_g_per_rthz.max() * G0_MPS2 / np.sqrt(2)),
        'accelerometer_random_walk': pytest.approx(3e-5 * G0_MPS2)}


def test_broadcaster(exported):
    parameters = yaml.safe_load(exported['broadcaster'].text)[
        'imu_sensor_broadcaster']['ros__parameters']
    covariance = parameters['static_covariance_linear_acceleration']
    assert all(isinstance(value, float) for value in covariance)
    std_mps2 = noise.sample_std_v(unit()) / unit().nominal_scale_v_per_g * G0_MPS2
    assert np.reshape(covariance, (3, 3)) == pytest.approx(np.diag([*std_mps2 ** 2, 1e6]))
    for absent in ('orientation', 'angular_velocity'):
        assert parameters[f'static_covariance_{absent}'] == [-1.0] + 8 * [0.0]


def test_json(exported, tmp_path):
    """It has the linear response, and the parameter file with every digit."""
    content = json.loads(exported['json'].text)
    assert [axis['zero_g_mps2'] for axis in content['axes']] == pytest.approx(
        zero_g_mps2(unit()).tolist())
    c, s = np.cos(MISALIGNED_RAD), np.sin(MISALIGNED_RAD)
    assert np.array(content['gain']) == pytest.approx(np.array([[c, s, 0], [-s, c, 0]]), abs=1e-6)
    assert content['position_m'] == list(ARM_M)
    # Optional parameters that the unit does not state are neutral.
    assert content['parameter_file'].items() >= parameter_file.to_flat(unit()).items()
    assert {part['name'] for part in content['parts']} >= set(unit().effects)
    # The linear response and the filter hold all of this unit but its second-order terms.
    assert content['not_held_mg'] < 0.01


def test_errors_are_one_line(tmp_path):
    parameter_file.save(tmp_path / 'unit.yaml', replace(
        nominal('x'), noise_density_g_per_rthz=np.zeros(1)))
    for arguments, status, words in (
            (('unit.yaml', '--to', 'kalibr', '-o', 'out.yaml'), 1, 'noise_density'),
            (('unit.yaml', '--to', 'json', '-o', 'unit.yaml'), 1, 'is the input itself'),
            (('none.yaml', '--to', 'json', '-o', 'out.json'), 1, 'cannot be read'),
            (('unit.yaml', '--to', 'urdf', '-o', 'out.urdf'), 2, 'invalid choice')):
        done = run_in_process('export', *arguments, cwd=tmp_path)
        assert done.returncode == status
        assert words in done.stderr.splitlines()[-1]
    assert [path.name for path in tmp_path.glob('*.*')] == ['unit.yaml']
