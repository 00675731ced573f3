# SPDX-License-Identifier: Apache-2.0

"""What no parameter file states is measured from the recording, not taken from another sensor."""

from pathlib import Path

from adxl_ros.files import parameter_file
from adxl_ros.model.signal_chain import static_response
import numpy as np
import pytest
from scipy.signal import lfilter

G = 9.80665
RATE_HZ = 200.0
ERROR = np.array([0.3, -0.2, 0.47 * G])
PARTIAL = """/**:
  ros__parameters:
    format: 1
    model: nominal
    sensor:
      serial: cam7
      axes: xyz
      nominal_zero_g_v: [0.0, 0.0, 0.0]
      nominal_scale_v_per_g: [1.0, 1.0, 1.0]
      rate_hz: 100.0
      range_g: 1.2
      local_gravity_mps2: 9.80665
      z_sign: 1
    stage:
      resolution_rad: 0.001
"""


def tumble(path: Path, noise_mps2: float, tau_s: float = 0.0, step_mps2: float = 0.0) -> Path:
    """Write a recording of a digital sensor that a hand turns through 30 rests."""
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    rests = np.repeat(directions * G + ERROR, round(3 * RATE_HZ), axis=0)
    moves = rng.normal(0, 6.0, (30, round(0.5 * RATE_HZ), 3))
    noise = rng.normal(0, 1, (len(rests), 3))
    if tau_s:
        a = np.exp(-1 / (RATE_HZ * tau_s))
        noise = lfilter([np.sqrt(1 - a * a)], [1, -a], noise, axis=0)
    parts = (rests + noise_mps2 * noise).reshape(30, -1, 3)
    samples = np.concatenate([parts, moves], axis=1).reshape(-1, 3)
    if step_mps2:
        samples = np.round(samples / step_mps2) * step_mps2
    rows = [
        f'{i / RATE_HZ!r},{",".join(map(repr, row))}' for i, row in enumerate(samples.tolist())
    ]
    path.write_text('\n'.join(['time_s,ax_mps2,ay_mps2,az_mps2', *rows]) + '\n')
    return path


@pytest.mark.parametrize('tau_s', [0.0, 0.02])
def test_fit_measures_the_sensor(run_tool, tmp_path, tau_s) -> None:
    """Noise, filter, resolution and range are those of the recording, in file and terminal."""
    path = tumble(tmp_path / 'a.csv', 0.05, tau_s, 0.01)
    done = run_tool('fit', path, '-o', tmp_path / 'unit.yaml')
    assert done.returncode == 0, done.stderr
    unit = parameter_file.load(tmp_path / 'unit.yaml')
    bandwidth_hz = 0.25 / tau_s if tau_s else RATE_HZ / 2
    np.testing.assert_allclose(
        unit.noise_density_g_per_rthz * G * np.sqrt(bandwidth_hz), 0.05, rtol=0.15
    )
    assert unit.rc_s == pytest.approx(tau_s, rel=0.15)
    assert unit.range_g == pytest.approx(4.0), 'the largest reading is between 2 and 4 g'
    for text in (done.stdout, (tmp_path / 'unit.yaml').read_text()):
        assert 'Measured, as no parameter file states it' in text
        assert 'resolution: x 1 mg, y 1 mg, z 1 mg' in text
    np.testing.assert_allclose(unit.values['bias']['offset_v'] * G, ERROR, atol=0.02)


def test_stated_values_stand_and_readings_beyond_them_are_reported(run_tool, tmp_path) -> None:
    """The file states the range: it stands, and readings beyond it are counted."""
    path = tumble(tmp_path / 'a.csv', 0.05)
    params = tmp_path / 'cam7.yaml'
    params.write_text(PARTIAL)
    done = run_tool('fit', path, '--params', params, '-o', tmp_path / 'unit.yaml', '--store', '')
    assert done.returncode == 0, done.stderr
    assert 'beyond the stated range of ±1.2 g' in done.stderr
    unit = parameter_file.load(tmp_path / 'unit.yaml')
    assert (unit.serial, unit.range_g) == ('cam7', 1.2)
    assert 'range:' not in done.stdout and 'noise of a sample' in done.stdout
    done = run_tool('apply', path, '--params', tmp_path / 'unit.yaml', '-o', tmp_path / 'o.csv')
    assert done.returncode == 0, done.stderr
    assert 'beyond the stated range of ±1.2 g' in done.stderr


def test_what_cannot_be_measured_is_refused(run_tool, tmp_path) -> None:
    """A simulation needs all values, and a recording must be long enough."""
    params = tmp_path / 'cam7.yaml'
    params.write_text(PARTIAL)
    done = run_tool('simulate', 'rich', '--params', params, '-o', tmp_path / 's.csv')
    assert done.returncode == 1
    assert 'sensor.noise_density_g_per_rthz: missing' in done.stderr
    lines = tumble(tmp_path / 'a.csv', 0.05).read_text().splitlines()[:30]
    (tmp_path / 'short.csv').write_text('\n'.join(lines) + '\n')
    done = run_tool('fit', tmp_path / 'short.csv', '-o', tmp_path / 'unit.yaml')
    assert done.returncode == 1
    assert '29 samples at 200 Hz do not show the noise of the sensor' in done.stderr


FACES_DEG = {
    '+x': (90, 0),
    '-x': (90, 180),
    '+y': (90, -90),
    '-y': (90, 90),
    '+z': (0, 0),
    '-z': (180, 0),
}
MATRIX = np.eye(3) + np.array(
    [[0.01, 0.004, -0.003], [0.002, -0.02, 0.006], [-0.005, 0.001, 0.015]]
)


def faces(path: Path, names: list[str]) -> Path:
    """Write rests on faces whose angles are stated; between them the angles are empty."""
    rng = np.random.default_rng(2)
    rows: list[str] = []
    for name in names:
        alpha, beta = np.radians(FACES_DEG[name])
        force = G * np.array(
            [np.sin(alpha) * np.cos(beta), -np.sin(alpha) * np.sin(beta), np.cos(alpha)]
        )
        rest = MATRIX @ force + ERROR + rng.normal(0, 0.05, (600, 3))
        move = rng.normal(0, 3.0, (200, 3))
        angles = f'{float(alpha)!r},{float(beta)!r}'
        rows += [f'{",".join(map(repr, row))},{angles}' for row in rest.tolist()]
        rows += [f'{",".join(map(repr, row))},,' for row in move.tolist()]
    lines = [f'{i / RATE_HZ!r},{row}' for i, row in enumerate(rows)]
    path.write_text(
        '\n'.join(['time_s,ax_mps2,ay_mps2,az_mps2,alpha_rad,beta_rad', *lines]) + '\n'
    )
    return path


def matrix_of(unit) -> np.ndarray:
    """Return the matrix of an affine unit, g/g, (3, 3): columns by finite differences."""
    respond = static_response(unit)
    zero = np.array(respond([0.0, 0.0, 0.0]))
    return np.column_stack([np.array(respond(list(row * G))) - zero for row in np.eye(3)])


def test_six_known_faces_determine_twelve_coefficients(run_tool, tmp_path) -> None:
    path = faces(tmp_path / 'six.csv', list(FACES_DEG))
    done = run_tool('fit', path, '-o', tmp_path / 'unit.yaml')
    assert done.returncode == 0, done.stderr
    unit = parameter_file.load(tmp_path / 'unit.yaml')
    assert unit.effects[:3] == ('bias', 'scale_factor', 'misalignment')
    np.testing.assert_allclose(unit.zero_g_v * G, ERROR, atol=0.01)
    np.testing.assert_allclose(matrix_of(unit), MATRIX, atol=0.002)


def test_an_open_coefficient_is_named_and_the_others_are_fitted(run_tool, tmp_path) -> None:
    """Without a face of z, the scale factor of z has its prior; zero-g of z is known."""
    path = faces(tmp_path / 'four.csv', ['+x', '-x', '+y', '-y'])
    done = run_tool('fit', path, '-o', tmp_path / 'unit.yaml')
    assert done.returncode == 0, done.stderr
    assert 'open, by its prior alone: scale_factor.offset_v_per_g.z' in done.stdout.replace(
        '\n  ', ' '
    )
    unit = parameter_file.load(tmp_path / 'unit.yaml')
    np.testing.assert_allclose(unit.zero_g_v * G, ERROR, atol=0.03)
    np.testing.assert_allclose(unit.scale_v_per_g[:2], np.diag(MATRIX)[:2], atol=0.002)
    std = dict(zip(map(str, unit.covariance_names), np.sqrt(np.diag(unit.covariance))))
    assert std['scale_factor.offset_v_per_g.z'] > 20 * std['scale_factor.offset_v_per_g.x']
