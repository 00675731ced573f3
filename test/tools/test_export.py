# SPDX-License-Identifier: Apache-2.0

"""
A sensor in the formats of other software: each file is read by its reader and compared.

Software that is too large to install is replaced by what its source says, of a stated version.
"""

from dataclasses import dataclass, make_dataclass, replace
import json
import sys
from types import ModuleType, SimpleNamespace
from typing import Annotated, ClassVar
from xml.etree import ElementTree

from adxl_ros.files import parameter_file
from adxl_ros.files.exports import formats
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.gyroscope import Gyroscope
from adxl_ros.simulate.sensor_model import SensorModel
import numpy as np
from processes import run_in_process
from pydantic import ConfigDict, create_model, Field
import pytest
from units import nominal
import yaml

COLUMNS = 79
ARM_M = (0.01, -0.02, 0.03)
OFFSET_V = np.array([0.03, -0.05])
WALK_MPS2 = np.array([2e-5, 3e-5]) * G0_MPS2
MISALIGNED_RAD = 0.01
# Elements of SDFormat 1.9, noise.sdf.
NOISE_ELEMENTS = {
    'mean',
    'stddev',
    'bias_mean',
    'bias_stddev',
    'dynamic_bias_stddev',
    'dynamic_bias_correlation_time',
    'precision',
}


def unit():
    """Return a sensor with effects that some formats hold and others do not."""
    return replace(
        nominal('xy'),
        serial='SN--7',
        effects=('bias', 'misalignment', 'lever_arm', 'bias_walk'),
        values={
            'bias': {'offset_v': OFFSET_V},
            'misalignment': {'alpha_rad': np.zeros(2), 'beta_rad': np.full(2, MISALIGNED_RAD)},
            'lever_arm': {f'{axis}_m': np.array(m) for axis, m in zip('xyz', ARM_M)},
            'bias_walk': {'density_g_per_rts': WALK_MPS2 / G0_MPS2},
        },
    )


@pytest.fixture(scope='module')
def exported(tmp_path_factory):
    """Export the unit in all formats, and return the texts of the files and of the screens."""
    folder = tmp_path_factory.mktemp('export')
    parameter_file.save(folder / 'unit.yaml', unit())
    return {name: export(folder, name) for name in formats()}


def export(folder, name, sensor=None):
    if sensor is not None:
        parameter_file.save(folder / 'unit.yaml', sensor)
    done = run_in_process('export', 'unit.yaml', '--to', name, '-o', f'out.{name}', cwd=folder)
    assert done.returncode == 0, done.stderr
    path = folder / f'out.{name}'
    return SimpleNamespace(path=path, text=path.read_text(), screen=done.stdout)


def mps2(volts):
    return volts / unit().nominal_scale_v_per_g * G0_MPS2


@pytest.mark.parametrize('name', sorted({*formats()} - {'json', 'genesis'}))
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
    assert (places['bias'] == 'not held') == (name not in ('sdf', 'isaaclab', 'mjlab', 'okvis2'))
    assert 'no z' in exported[name].text
    assert all(len(line) <= COLUMNS for line in lines if line.startswith('#'))
    assert max(map(len, exported[name].screen.splitlines())) <= COLUMNS


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
        assert values['mean'] == pytest.approx(mps2(OFFSET_V)[d])
        assert values['stddev'] == pytest.approx(mps2(noise.analog_std_v(unit()))[d])
        assert values['precision'] == pytest.approx(mps2(unit().lsb_v)[d])
        assert values['dynamic_bias_stddev'] == pytest.approx(WALK_MPS2[d])
        assert (values['bias_mean'], values['bias_stddev']) == (0.0, 0.0)


def test_mujoco(exported, monkeypatch):
    """The lines of Python in the head apply the whole chain to mjData."""
    mujoco = pytest.importorskip('mujoco', reason='mujoco is not installed: pip install mujoco')
    model = mujoco.MjModel.from_xml_path(str(exported['mujoco'].path))
    assert model.site('SN-7').pos == pytest.approx(ARM_M)
    assert model.sensor('SN-7').type[0] == mujoco.mjtSensor.mjSENS_ACCELEROMETER
    assert model.sensor_noise[0] == pytest.approx(mps2(noise.analog_std_v(unit())).max())
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    monkeypatch.chdir(exported['mujoco'].path.parent)
    lines = exported['mujoco'].text.split('after each mj_step:')[1].split('-->')[0]
    names = {'model': model, 'data': data}
    exec('\n'.join(line.strip() for line in lines.splitlines()), names)
    assert names['reading'][:2] == pytest.approx(mps2(OFFSET_V), abs=0.3)


class NoiseModel:
    """Base class of Isaac Lab 2.0 to 3.0 and mjlab 1.6: both refuse a class that is no child."""

    def __init__(self, noise_model_cfg, num_envs, device):
        raise AssertionError('it replaces the chain')


Gaussian = make_dataclass('GaussianNoiseCfg', ['mean', 'std', 'operation'])
"""Of Isaac Lab 2.0 to 3.0 and of mjlab 1.6."""


@dataclass(kw_only=True)
class MjlabNoiseModelCfg:
    """NoiseModelCfg of mjlab 1.6: children name their class."""

    noise_cfg: Gaussian
    class_type: ClassVar[type] = NoiseModel

    def __init_subclass__(cls, class_type):
        cls.class_type = class_type


def run_module(exported, name, monkeypatch, contents):
    for package, members in contents.items():
        module = ModuleType(package)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, package, module)
    monkeypatch.chdir(exported[name].path.parent)
    values = {'__name__': name}
    exec(compile(exported[name].text, name, 'exec'), values)
    return values


def check_noise(values):
    acceleration = values['ACCELERATION_NOISE']
    assert acceleration.operation == 'add'
    assert acceleration.mean == pytest.approx([*mps2(OFFSET_V), 0.0])
    assert acceleration.std == pytest.approx([*mps2(noise.analog_std_v(unit())), 0.0])
    chain = values['WHOLE_CHAIN']
    assert chain.noise_cfg is acceleration
    assert issubclass(chain.class_type, NoiseModel)
    model = chain.class_type(chain, num_envs=2, device='cpu')
    model.reset()
    force = np.tile([0.0, 0.0, G0_MPS2], (2, 1))
    expected = SensorModel('unit.yaml')
    for _ in range(3):
        assert model(force) == pytest.approx(expected(force, 1 / unit().rate_hz))
        model.reset(np.array([1]))
        expected.reset([1])


@pytest.mark.parametrize('version', ['2.3', '3.0'])
def test_isaaclab(exported, monkeypatch, version):
    """Data is a tensor in 2.x, and a ProxyArray since 3.0 (concepts/sensors/imu.rst)."""
    offset = make_dataclass('OffsetCfg', ['pos'])  # Its default of rot is no turn in both
    values = run_module(
        exported,
        'isaaclab',
        monkeypatch,
        {
            'isaaclab': {},
            'isaaclab.utils': {},
            'torch': {'tensor': np.array},
            'isaaclab.sensors': {'ImuCfg': SimpleNamespace(OffsetCfg=offset)},
            'isaaclab.utils.noise': {},
            'isaaclab.utils.noise.noise_model': {'NoiseModel': NoiseModel},
            'isaaclab.utils.noise.noise_cfg': {
                'GaussianNoiseCfg': Gaussian,
                'NoiseModelCfg': make_dataclass('NoiseModelCfg', ['class_type', 'noise_cfg']),
            },
        },
    )
    assert values['OFFSET'] == offset(ARM_M)
    assert values['UPDATE_PERIOD_S'] == pytest.approx(1 / unit().rate_hz)
    tensor = np.zeros((2, 3))
    data = tensor if version == '2.3' else SimpleNamespace(torch=tensor)
    env = SimpleNamespace(scene={'imu': SimpleNamespace(data=SimpleNamespace(lin_acc_b=data))})
    assert values['acceleration'](env) is tensor
    check_noise(values)


def test_mjlab(exported, monkeypatch):
    """A name is that of the entity and its own (mjlab 1.6, builtin_sensor.py)."""
    values = run_module(
        exported,
        'mjlab',
        monkeypatch,
        {
            'mjlab': {},
            'mjlab.utils': {},
            'mjlab.sensor': {
                'BuiltinSensorCfg': make_dataclass(
                    'BuiltinSensorCfg', ['name', 'sensor_type', 'obj']
                ),
                'ObjRef': make_dataclass('ObjRef', ['type', 'name', 'entity']),
            },
            'mjlab.utils.noise': {
                'GaussianNoiseCfg': Gaussian,
                'NoiseModel': NoiseModel,
                'NoiseModelCfg': MjlabNoiseModelCfg,
            },
        },
    )
    sensor = values['ACCELEROMETER']
    assert (sensor.sensor_type, sensor.obj.type, sensor.obj.name) == (
        'accelerometer',
        'site',
        values['NAME'],
    )
    assert values['POS'] == ARM_M
    # Tensors are made of tuples of floats.
    assert isinstance(values['ACCELERATION_NOISE'].std, tuple)
    name = f'{sensor.obj.entity}/{sensor.name}'
    env = SimpleNamespace(scene={name: SimpleNamespace(data='data')})
    assert values['acceleration'](env) == 'data'
    check_noise(values)


NotNegative = Annotated[float, Field(ge=0)]
Three = Annotated[tuple[float, float, float], Field(strict=False)]
GenesisImu = create_model(
    'GenesisImu',
    __config__=ConfigDict(strict=True, extra='forbid'),
    **dict.fromkeys(
        ('pos_offset', 'acc_bias', 'acc_noise', 'acc_random_walk', 'acc_resolution'), (Three, ...)
    ),
    **dict.fromkeys(('delay', 'jitter'), (NotNegative, ...)),
)
"""Options of gs.sensors.IMU in Genesis 0.4.5 and 1.4.5, by the rules of options/sensors."""


def test_genesis(exported, monkeypatch, tmp_path):
    """The sensor multiplies, adds walk, noise and bias, and rounds (Genesis 1.4.5, imu.py)."""
    values = run_module(exported, 'genesis', monkeypatch, {})
    options = GenesisImu(**values['ACCELEROMETER'])
    assert options.jitter <= options.delay
    assert options.pos_offset == ARM_M
    force = np.array([1.0, -2.0, G0_MPS2])
    step = options.acc_resolution[0]
    biased = np.array(values['CROSS_AXIS_COUPLING']) @ force + options.acc_bias
    quiet = replace(unit(), noise_density_g_per_rthz=np.zeros(2), effects=('bias', 'misalignment'))
    reading = SensorModel(quiet)(force, values['DT_S'])
    assert reading[:2] == pytest.approx(np.round(biased[:2] / step) * step, abs=1.01 * step)
    assert options.acc_noise == pytest.approx([*mps2(noise.analog_std_v(unit())), 0.0])
    # It adds one draw a step: after 1 s the walk has the density of the unit.
    assert np.array(options.acc_random_walk)[:2] * np.sqrt(unit().rate_hz) == pytest.approx(
        WALK_MPS2
    )
    rows = [line.split() for line in exported['genesis'].text.splitlines()]
    assert [row[1] for row in rows if row[-2:] == ['not', 'held']] == ['RC']


@pytest.mark.parametrize('offset_s', [0.02, -0.02])
def test_genesis_holds_a_delay_but_no_lead(tmp_path, offset_s):
    sensor = nominal(
        'x', effects=('time_offset',), values={'time_offset': {'offset_s': np.array(offset_s)}}
    )
    text, values = export(tmp_path, 'genesis', sensor).text, {}
    row = next(line for line in text.splitlines() if line.startswith('# time_offset'))
    exec(text, values)
    assert values['ACCELEROMETER']['delay'] == max(offset_s, 0.0)
    assert row.endswith('delay' if offset_s > 0 else 'not held')


def sample_variance():
    return (mps2(noise.sample_std_v(unit())) ** 2).max()


def test_okvis2(exported):
    """
    OKVIS2 wants real numbers and sequences (ViParametersReader.cpp, commit 464180a).

    Its covariance grows by sigma² dt (ImuError.cpp), so that its densities are those of Kalibr.
    """
    own = yaml.safe_load(exported['okvis2'].text)['imu_parameters']
    kalibr = yaml.safe_load(exported['kalibr'].text)
    assert own['sigma_a_c'] == kalibr['accelerometer_noise_density']
    assert own['sigma_aw_c'] == kalibr['accelerometer_random_walk']
    assert own['a0'] == pytest.approx([*mps2(OFFSET_V), 0.0])
    assert own['a_max'] == pytest.approx(unit().range_g * G0_MPS2)
    assert own['g'] == unit().local_gravity_mps2
    assert all(isinstance(value, float) for value in [*own.pop('a0'), *own.values()])
    named = exported['okvis2'].text.partition('are yours: ')[2].partition('imu_parameters')[0]
    assert {*own, 'a0', *named.replace('#', '').replace(',', ' ').split()} == {
        'use',
        'T_BS',
        'a_max',
        'g_max',
        'sigma_g_c',
        'sigma_bg',
        'sigma_a_c',
        'sigma_ba',
        'sigma_gw_c',
        'sigma_aw_c',
        'a0',
        'g0',
        'g',
    }


def test_fusioncore(exported):
    """R is accel_noise², and Q is added once a step (FusionCore 0.3.7, imu.hpp and ukf.cpp)."""
    parameters = yaml.safe_load(exported['fusioncore'].text)['fusioncore']['ros__parameters']
    assert all(isinstance(value, float) for value in parameters.values())
    assert parameters == {
        'imu.accel_noise': pytest.approx(np.sqrt(sample_variance())),
        'ukf.q_accel_bias': pytest.approx((3e-5 * G0_MPS2) ** 2 / unit().rate_hz),
        **{f'imu.lever_arm_{axis}': m for axis, m in zip('xyz', ARM_M)},
    }


def test_point_lio(exported):
    """
    Point-LIO, commit ef96597: it adds b_acc_cov·dt² a step (esekfom.hpp).

    A reading counts as acc·|gravity|/acc_norm, and as clipped from 0.99 satu_acc (Estimator.cpp).
    """
    own = yaml.safe_load(exported['point_lio'].text)['mapping']
    assert np.linalg.norm(own['gravity']) / own['acc_norm'] == 1
    assert own['satu_acc'] == pytest.approx(unit().range_g * G0_MPS2)
    assert own['imu_meas_acc_cov'] == own['acc_cov_input'] == pytest.approx(sample_variance())
    dt_s = own['imu_time_inte']
    assert own['b_acc_cov'] * dt_s**2 == pytest.approx((3e-5 * G0_MPS2) ** 2 * dt_s)


def test_an_estimator_learns_the_first_limit(tmp_path):
    sensor = nominal(
        'xy', effects=('saturation',), values={'saturation': {'limit_g': np.array([1.2, 1.5])}}
    )
    own = yaml.safe_load(export(tmp_path, 'okvis2', sensor).text)['imu_parameters']
    assert own['a_max'] == pytest.approx(1.2 * G0_MPS2)


def test_kalibr(exported):
    """
    Kalibr reads these keys with PyYAML, and refuses values that are not positive floats.

    A sample of its noise has the variance N²·rate (ethz-asl/kalibr, wiki/IMU-Noise-Model), and
    white noise of the density d of a datasheet has d²·rate/2. The rounding of the ADC adds to it.
    """
    values = yaml.safe_load(exported['kalibr'].text)
    white_v2_per_hz = noise.density_v2_per_hz(unit(), np.zeros(1)).max() / 2
    assert np.sqrt(2 * white_v2_per_hz) == pytest.approx(
        unit().noise_density_g_per_rthz.max() * unit().nominal_scale_v_per_g.max(), rel=1e-3
    )
    assert values == {
        'rostopic': '/imu/data_raw',
        'update_rate': unit().rate_hz,
        'accelerometer_noise_density': pytest.approx(mps2(np.sqrt(white_v2_per_hz)).max()),
        'accelerometer_random_walk': pytest.approx(3e-5 * G0_MPS2),
    }


def test_broadcaster(exported):
    parameters = yaml.safe_load(exported['broadcaster'].text)['imu_sensor_broadcaster'][
        'ros__parameters'
    ]
    covariance = parameters['static_covariance_linear_acceleration']
    assert all(isinstance(value, float) for value in covariance)
    assert np.reshape(covariance, (3, 3)) == pytest.approx(
        np.diag([*mps2(noise.sample_std_v(unit())) ** 2, 1e6])
    )
    for absent in ('orientation', 'angular_velocity'):
        assert parameters[f'static_covariance_{absent}'] == [-1.0] + 8 * [0.0]


def test_the_gyroscope_in_each_format_that_holds_one(tmp_path):
    """
    A density d over positive frequencies is d/√2 over both, with a variance of d²·rate/2 a sample.

    A walk that is not known is the largest that an hour at rest hides: K·√(τ/3) = N/√τ.
    """
    density, bias = (1e-4, 3e-4, 2e-4), [0.01, -0.02, 0.03]
    sensor = replace(
        unit(),
        gyro=Gyroscope(
            bias_radps=tuple(bias),
            noise_density_radps_per_rthz=density,
            walk_radps_per_rts=(2e-6, 4e-6, 3e-6),
        ),
    )
    white, k, rate_hz = 3e-4 / np.sqrt(2), 4e-6, sensor.rate_hz
    expected = {
        'kalibr': {
            'gyroscope_noise_density': (white, 'rad/s/sqrt(Hz)'),
            'gyroscope_random_walk': (k, 'rad/s^2/sqrt(Hz)'),
        },
        'okvis2': {
            'sigma_g_c': (white, 'rad/s/sqrt(Hz)'),
            'sigma_gw_c': (k, 'rad/s^2/sqrt(Hz)'),
            'g0': (bias, 'rad/s'),
        },
        'fusioncore': {
            'imu.gyro_noise': (white * np.sqrt(rate_hz), 'rad/s'),
            'ukf.q_gyro_bias': (k**2 / rate_hz, '(rad/s)^2 a sample'),
        },
        'point_lio': {
            'imu_meas_omg_cov': (white**2 * rate_hz, '(rad/s)^2'),
            'gyr_cov_input': (white**2 * rate_hz, '(rad/s)^2'),
            'b_gyr_cov': (k**2 * rate_hz, '(rad/s)^2/s^2'),
        },
        'broadcaster': {
            'static_covariance_angular_velocity': (
                np.diag(np.square(density) / 2 * rate_hz).ravel().tolist(),
                '',
            )
        },
    }
    for name, lines in expected.items():
        text = export(tmp_path, name, sensor).text
        for key, (value, stated_unit) in lines.items():
            (line,) = (each for each in text.splitlines() if each.strip().startswith(f'{key}:'))
            written, _, comment = line.partition('  # ')
            assert yaml.safe_load(written)[key] == pytest.approx(value, rel=1e-9), line
            assert comment == stated_unit
    hidden = replace(sensor, gyro=replace(sensor.gyro, walk_radps_per_rts=()))
    kalibr = yaml.safe_load(export(tmp_path, 'kalibr', hidden).text)
    assert kalibr['gyroscope_random_walk'] == pytest.approx(white * np.sqrt(3) / 3600)


def test_json(exported, tmp_path):
    content = json.loads(exported['json'].text)
    assert [axis['zero_g_mps2'] for axis in content['axes']] == pytest.approx(
        mps2(OFFSET_V).tolist()
    )
    c, s = np.cos(MISALIGNED_RAD), np.sin(MISALIGNED_RAD)
    assert np.array(content['gain']) == pytest.approx(np.array([[c, s, 0], [-s, c, 0]]), abs=1e-6)
    assert content['position_m'] == list(ARM_M)
    # Optional parameters that the unit does not state are neutral.
    assert content['parameter_file'].items() >= parameter_file.to_flat(unit()).items()
    assert {part['name'] for part in content['parts']} >= set(unit().effects)
    # The linear response and the filter hold all of this unit but its second-order terms.
    assert content['not_held_mg'] < 0.01


def test_errors_are_one_line(tmp_path):
    parameter_file.save(
        tmp_path / 'unit.yaml', replace(nominal('x'), noise_density_g_per_rthz=np.zeros(1))
    )
    for arguments, status, words in (
        (('unit.yaml', '--to', 'kalibr', '-o', 'out.yaml'), 1, 'noise_density'),
        (('unit.yaml', '--to', 'json', '-o', 'unit.yaml'), 1, 'is the input itself'),
        (('none.yaml', '--to', 'json', '-o', 'out.json'), 1, 'cannot be read'),
        (('unit.yaml', '--to', 'urdf', '-o', 'out.urdf'), 2, 'invalid choice'),
    ):
        done = run_in_process('export', *arguments, cwd=tmp_path)
        assert done.returncode == status
        assert words in done.stderr.splitlines()[-1]
    assert [path.name for path in tmp_path.glob('*.*')] == ['unit.yaml']
