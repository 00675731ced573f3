# SPDX-License-Identifier: Apache-2.0

"""Logs of other software, from the file as it came to a calibrated parameter file."""

from pathlib import Path
import shlex

from adxl_ros.files import parameter_file
from adxl_ros.model.constants import G0_MPS2
from bags import bag_of, EPOCH_NS, imu
from foreign_logs import BIAS_G, FORMS, lines, SCALE, text_with_angles, Turned, turned, ulog
import numpy as np
from processes import REPO
import pytest
from without_extras import run_without_extras

pytestmark = pytest.mark.long

XYZ_G = 'time=t:s,x=x:g,y=y:g,z=z:g'
LOG = turned()
SHORT = 't,x,y,z\n' + ''.join(f'{i / 100},0.01,-0.02,{1 + i % 3 / 1e3}\n' for i in range(500))
NO_SERIAL = 'time=t:s,x=x,y=y,z=z'


def written(folder: Path, name: str, text: str | bytes) -> str:
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return name


def plain_text(columns: list[np.ndarray]) -> str:
    """Return a table of time in s and outputs in g."""
    return 't,x,y,z\n' + lines(columns, ['%.3f'] + ['%.5f'] * 3)


def proposed(error: str) -> list[str]:
    assert error.count('\n') == 1, error
    return shlex.split(error[error.index('--columns') :].replace('--rate HZ', '--rate 100'))


def check_errors(path: Path, atol_g: float = 2e-3) -> None:
    fitted = parameter_file.load(path, may_measure=True)
    scale = fitted.nominal_scale_v_per_g
    np.testing.assert_allclose(
        (fitted.zero_g_v - fitted.nominal_zero_g_v) / scale, BIAS_G, atol=atol_g
    )
    np.testing.assert_allclose(fitted.scale_v_per_g / scale, SCALE, atol=2e-3)


@pytest.mark.parametrize('name', FORMS)
def test_two_commands_from_a_log_to_a_calibration(run_tool, tmp_path, name) -> None:
    """The first answer proposes the columns and writes nothing; with them `fit` calibrates."""
    written(tmp_path, name, FORMS[name](LOG))
    done = run_tool('fit', name, '-o', 'unit.yaml')
    assert done.returncode == 1 and not (tmp_path / 'unit.yaml').exists()
    done = run_tool('fit', name, '-o', 'unit.yaml', *proposed(done.stderr))
    assert done.returncode == 0, done.stderr
    check_errors(tmp_path / 'unit.yaml')
    following = shlex.split(done.stdout[done.stdout.index('ros2 run') :].replace('\\\n', ' '))
    done = run_tool(*following[3:])
    assert done.returncode == 0, done.stderr


def test_counts_about_an_offset(run_tool, tmp_path) -> None:
    """Counts of a 10 bit ADC, as an analog sensor on a board gives them."""
    counts = 512 + 102 * LOG.output_g
    rows = lines([1e3 * LOG.time_s, *counts.T], ['%.0f'] + ['%.2f'] * 3, ' ')
    written(tmp_path, 'adc.txt', 'ms A0 A1 A2\n' + rows)
    done = run_tool('fit', 'adc.txt', '-o', 'unit.yaml')
    options = proposed(done.stderr)
    assert options[:2] == ['--columns', 'time=ms:ms,x=A0:lsb,y=A1:lsb,z=A2:lsb']
    assert float(options[options.index('--lsb-at-0g') + 1]) == pytest.approx(512, abs=6)
    assert float(options[options.index('--lsb-per-g') + 1]) == pytest.approx(102, abs=4)
    done = run_tool(
        'fit',
        'adc.txt',
        '-o',
        'unit.yaml',
        '--columns',
        options[1],
        '--lsb-per-g',
        102,
        '--lsb-at-0g',
        512,
    )
    assert done.returncode == 0, done.stderr
    check_errors(tmp_path / 'unit.yaml')


@pytest.mark.parametrize('name', ['log.npz', 'log.parquet', 'log.ulg'])
def test_tables_of_libraries(run_tool, tmp_path, name) -> None:
    if name == 'log.npz':
        np.savez(tmp_path / name, t=LOG.time_s, acc=LOG.output_g, note=np.array('still'))
    elif name == 'log.parquet':
        parquet = pytest.importorskip('pyarrow.parquet', reason='no pyarrow')
        import pyarrow

        stamps = (EPOCH_NS + np.rint(1e9 * LOG.time_s)).astype(np.int64)
        parquet.write_table(
            pyarrow.table(
                {
                    'stamp': pyarrow.array(stamps, pyarrow.timestamp('ns')),
                    'device': ['a'] * len(stamps),
                    **{f'acc_{axis}': LOG.output_g[:, i] for i, axis in enumerate('xyz')},
                }
            ),
            tmp_path / name,
        )
    else:
        pytest.importorskip('pyulog', reason='no pyulog')
        (tmp_path / name).write_bytes(ulog(LOG))
    done = run_tool('fit', name, '-o', 'unit.yaml')
    if name != 'log.ulg':  # its format states columns and units
        assert done.returncode == 1
        done = run_tool('fit', name, '-o', 'unit.yaml', *proposed(done.stderr))
    assert done.returncode == 0, done.stderr
    check_errors(tmp_path / 'unit.yaml')


@pytest.mark.parametrize('name', ['log.npz', 'log.parquet', 'log.ulg'])
def test_a_file_of_another_format_is_refused_in_one_line(run_tool, tmp_path, name) -> None:
    (tmp_path / name).write_bytes(bytes(range(256)))
    done = run_tool('fit', name, '-o', 'unit.yaml')
    assert done.returncode == 1 and done.stderr.count('\n') == 1
    assert done.stderr.startswith(f'fit: {name}: cannot read it as '), done.stderr


@pytest.mark.parametrize(('name', 'package'), [('a.parquet', 'pyarrow'), ('a.ulg', 'pyulog')])
def test_a_missing_library_is_named(tmp_path, name, package) -> None:
    (tmp_path / name).write_bytes(b'')
    done = run_without_extras(
        'import sys\nfrom adxl_ros.files import recording\n'
        'from adxl_ros.errors import UserError\n'
        'try:\n    recording.read(sys.argv[1])\n'
        'except UserError as error:\n    print(error)\n',
        str(tmp_path / name),
    )
    assert done.returncode == 0, done.stderr
    assert ' pip install ' in done.stdout and done.stdout.endswith(f' {package}\n'), done.stdout


@pytest.mark.parametrize('names', ['angle;beta', 'roll;pitch'])
def test_angles_in_a_log_are_the_reference(run_tool, tmp_path, names) -> None:
    """Degrees, empty in motion, and in a whole rest: `fit` keeps the stage as reference."""
    angles = np.degrees(LOG.angles_rad) if names == 'angle;beta' else LOG.tilt_deg
    angles[(LOG.time_s > 10.5) & (LOG.time_s < 14)] = np.nan
    written(tmp_path, 'log.csv', text_with_angles(LOG, angles, names))
    done = run_tool('fit', 'log.csv', '-o', 'unit.yaml')
    done = run_tool('fit', 'log.csv', '-o', 'unit.yaml', *proposed(done.stderr))
    assert done.returncode == 0, done.stderr
    fitted = parameter_file.load(tmp_path / 'unit.yaml')
    assert fitted.provenance['reference'] == 'stage'
    assert 'rests without angles, left out: 1 (the first one from 10.' in ' '.join(
        done.stdout.split()
    )
    check_errors(tmp_path / 'unit.yaml', 5e-3)


def pose_table(log: Turned) -> list[str]:
    starts = np.flatnonzero(np.diff(np.isfinite(log.angles_rad[:, 0]).astype(int), prepend=0) > 0)
    rows = []
    for start in starts:
        alpha, beta = np.degrees(log.angles_rad[start])
        rows.append(f'{alpha:.3f},' + (f'{beta:.3f}' if 1 < alpha < 179 else ''))
    return rows


def test_a_table_of_poses_is_the_reference(run_tool, tmp_path) -> None:
    written(tmp_path, 'log.csv', plain_text([LOG.time_s, *LOG.output_g.T]))
    rows = pose_table(LOG)
    rows[3] = ','
    written(tmp_path, 'poses.csv', 'alpha_deg,beta_deg\n' + '\n'.join(rows) + '\n')
    done = run_tool('fit', 'log.csv', '--columns', XYZ_G, '--poses', 'poses.csv', '-o', 'u.yaml')
    assert done.returncode == 0, done.stderr
    fitted = parameter_file.load(tmp_path / 'u.yaml')
    assert fitted.provenance['reference'] == 'stage'
    assert fitted.provenance['poses'].startswith('31')
    check_errors(tmp_path / 'u.yaml', 5e-3)
    written(tmp_path, 'poses.csv', 'alpha_deg,beta_deg\n' + '\n'.join(rows[:-1]) + '\n')
    done = run_tool('fit', 'log.csv', '--columns', XYZ_G, '--poses', 'poses.csv', '-o', 'v.yaml')
    assert (
        'poses.csv: has 31 poses, but the recording has 32 rests, which begin at 0.' in done.stderr
    )


def test_a_table_of_an_inclinometer_names_its_rests(run_tool, tmp_path) -> None:
    written(tmp_path, 'log.csv', plain_text([LOG.time_s, *LOG.output_g.T]))
    starts = np.flatnonzero(np.diff(np.isfinite(LOG.angles_rad[:, 0]).astype(int), prepend=0) > 0)
    alpha, beta = LOG.angles_rad[starts].T
    x, y = np.sin(alpha) * np.cos(beta), -np.sin(alpha) * np.sin(beta)
    roll, pitch = np.degrees([np.arctan2(y, np.cos(alpha)), np.arcsin(-x)])
    rows = [
        f'{LOG.time_s[start]:.3f},{LOG.time_s[start + 150]:.3f},{r:.4f},{p:.4f}'
        for start, r, p in zip(starts, roll, pitch)
    ]
    command = 'fit', 'log.csv', '--columns', XYZ_G, '--poses', 'poses.csv', '-o', 'u.yaml'
    head = 'start_s,stop_s,roll_deg,pitch_deg\n'
    # Some rests are enough, in any number.
    written(tmp_path, 'poses.csv', head + '\n'.join(rows[:24]) + '\n')
    done = run_tool(*command)
    assert done.returncode == 0, done.stderr
    fitted = parameter_file.load(tmp_path / 'u.yaml')
    assert fitted.provenance['reference'] == 'stage'
    check_errors(tmp_path / 'u.yaml', 1e-2)
    written(tmp_path, 'poses.csv', head + rows[0] + '\n9e3,9.1e3,0,0\n')
    assert 'poses.csv: pose 2 is from 9000 to 9100 s, in which' in run_tool(*command).stderr
    written(tmp_path, 'poses.csv', 'start_s,roll_deg,pitch_deg\n1,0,0\n')
    assert 'has start_s; expected both start_s and stop_s' in run_tool(*command).stderr


@pytest.mark.parametrize('angles', ['', 'alpha_deg,beta_deg'])
def test_each_row_may_be_the_mean_of_a_rest(run_tool, tmp_path, angles) -> None:
    """Without the option the refusal names it; with it, the coefficients have an uncertainty."""
    starts = np.flatnonzero(np.diff(np.isfinite(LOG.angles_rad[:, 0]).astype(int), prepend=0) > 0)
    means = [LOG.output_g[start : start + 150].mean(axis=0) for start in starts]
    table = np.hstack([means, np.degrees(LOG.angles_rad[starts])])[:, : 5 if angles else 3]
    header = ','.join(filter(None, ['x', 'y', 'z', angles]))
    np.savetxt(tmp_path / 'means.csv', table, delimiter=',', header=header, comments='')
    columns = 'x=x:g,y=y:g,z=z:g' + ',alpha=alpha_deg,beta=beta_deg' * bool(angles)
    command = 'fit', 'means.csv', '--columns', columns, '-o', 'u.yaml'
    assert 'fit --means' in run_tool(*command, '--rate', 1).stderr
    done = run_tool(*command, '--means')
    if angles:
        assert done.returncode == 1 and 'sensor.noise_density_g_per_rthz' in done.stderr
        text = (
            parameter_file.usual_path(is_nominal=False)
            .read_text()
            .replace(
                'rate_hz:', 'noise_density_g_per_rthz: [4.0e-4, 4.0e-4, 4.0e-4]\n      rate_hz:'
            )
        )
        written(tmp_path, 'stated.yaml', text)
        done = run_tool(*command, '--means', '--params', 'stated.yaml')
    assert done.returncode == 0, done.stderr
    check_errors(tmp_path / 'u.yaml', 5e-3)
    fitted = parameter_file.load(tmp_path / 'u.yaml', may_measure=True)
    assert fitted.provenance['reference'] == ('stage' if angles else 'gravity')
    assert (np.diag(fitted.covariance) > 0).all() and 'range_g' in fitted.unstated
    done = run_tool('apply', *written_log(tmp_path), '--params', 'u.yaml', '-o', 'tilt.csv')
    assert done.returncode == 0 and 'Measured' in done.stdout, done.stderr


def written_log(folder: Path) -> list[str]:
    written(folder, 'log.csv', plain_text([LOG.time_s, *LOG.output_g.T]))
    return ['log.csv', '--columns', XYZ_G]


def test_the_advice_for_readings_in_g_works(run_tool, tmp_path) -> None:
    text = plain_text([LOG.time_s, *LOG.output_g.T])
    written(tmp_path, 'log.csv', text.replace('t,x,y,z', 'time_s,ax_mps2,ay_mps2,az_mps2', 1))
    refused = run_tool('fit', 'log.csv', '-o', 'u.yaml')
    assert refused.returncode == 1 and '--unit g' in refused.stderr
    done = run_tool('fit', 'log.csv', '--unit', 'g', '-o', 'u.yaml')
    assert done.returncode == 0, done.stderr
    check_errors(tmp_path / 'u.yaml')


def test_stamps_in_bursts(run_tool, tmp_path) -> None:
    """Eight samples share a stamp: refused and named; an index gives their times."""
    stamps = 0.08 * np.floor(LOG.time_s / 0.08 + 1e-9)
    written(tmp_path, 'log.csv', plain_text([stamps, *LOG.output_g.T]))
    command = ['fit', 'log.csv', '--columns', XYZ_G, '-o', 'unit.yaml']
    done = run_tool(*command)
    assert done.returncode == 1
    assert 'log.csv:3:1: t: time stands still' in done.stderr
    assert 'bursts of about 8 samples' in done.stderr and ' 100 Hz' in done.stderr
    done = run_tool(*command, '--rate', 100)
    assert done.returncode == 0, done.stderr
    check_errors(tmp_path / 'unit.yaml')
    written(
        tmp_path,
        'log.csv',
        't,x,y,z\n'
        + lines(
            [stamps + 1e-4 * (np.arange(len(stamps)) % 8), *LOG.output_g.T],
            ['%.4f'] + ['%.5f'] * 3,
        ),
    )
    done = run_tool(*command)
    assert done.returncode == 0 and 'bursts of about 8 samples' in done.stderr
    assert parameter_file.load(tmp_path / 'unit.yaml').rate_hz == pytest.approx(100, rel=0.01)


def test_bad_stamps_are_left_out_and_counted(run_tool, tmp_path) -> None:
    rows = FORMS['arduino.csv'](LOG).splitlines(keepends=True)
    rows[300:300] = rows[290:293]
    rows[200:200] = rows[199:200]
    written(tmp_path, 'log.csv', ''.join(rows))
    options = ['--columns', 'time=t_ms:ms,x=accX:mg,y=accY:mg,z=accZ:mg', '-o', 'unit.yaml']
    done = run_tool('fit', 'log.csv', *options)
    assert done.returncode == 1
    assert 'log.csv:201:1: t_ms: time stands still' in done.stderr
    assert '--drop-bad-stamps' in done.stderr
    done = run_tool('fit', 'log.csv', *options, '--drop-bad-stamps')
    assert done.returncode == 0, done.stderr
    assert 'samples with the stamp of the one before: 1\n' in done.stderr
    assert 'samples whose stamp steps back: 3\n' in done.stderr
    check_errors(tmp_path / 'unit.yaml')


def test_volts_of_another_sensor(run_tool, tmp_path) -> None:
    """Volts about 1.65 V: the answer asks for the file of the sensor, which then calibrates."""
    volts = 1.65 + 0.33 * LOG.output_g
    written(
        tmp_path,
        'log.csv',
        't,Vx,Vy,Vz,AngleX(deg)\n'
        + lines([LOG.time_s, *volts.T, 0 * LOG.time_s], ['%.3f'] + ['%.5f'] * 3 + ['%.1f']),
    )
    done = run_tool('fit', 'log.csv', '-o', 'unit.yaml')
    assert '--params takes the parameter file of the sensor' in done.stderr
    options = proposed(done.stderr)
    assert options == ['--columns', 'time=t:s,x=Vx:v,y=Vy:v,z=Vz:v']
    done = run_tool('fit', 'log.csv', '-o', 'unit.yaml', *options)
    assert '--params needs the file of this sensor' in done.stderr and done.stderr.count('\n') == 1
    params = REPO / 'params' / 'adxl335.yaml'
    done = run_tool('fit', 'log.csv', '-o', 'unit.yaml', *options, '--params', params)
    assert done.returncode == 0, done.stderr
    check_errors(tmp_path / 'unit.yaml')


def test_a_documented_mounting(run_tool, tmp_path) -> None:
    """The log has x along -y of the sensor; --axes brings both together."""
    x, y, z = LOG.output_g.T
    written(tmp_path, 'log.csv', plain_text([LOG.time_s, -y, x, z]))
    done = run_tool('fit', 'log.csv', '--columns', XYZ_G, '--axes', 'x=y,y=-x,z=z', '-o', 'u.yaml')
    assert done.returncode == 0, done.stderr
    check_errors(tmp_path / 'u.yaml')


def test_a_counter_that_is_named_as_a_time_is_asked_for_its_rate(run_tool, tmp_path) -> None:
    rows = [np.arange(float(len(LOG.time_s))), *G0_MPS2 * LOG.output_g.T]
    written(tmp_path, 'log.csv', 'n,x,y,z\n' + lines(rows, ['%.0f'] + ['%.4f'] * 3))
    columns = 'time=n:s,x=x:mps2,y=y:mps2,z=z:mps2'
    done = run_tool('check', 'log.csv', '--columns', columns)
    assert 'if it counts samples, give --rate HZ' in ' '.join(done.stdout.split())


def test_a_row_of_units_below_the_names(run_tool, tmp_path) -> None:
    rows = [1e3 * LOG.time_s, *LOG.output_g.T]
    head = 'Time,X,Y,Z\nms,g,g,g\n'
    written(tmp_path, 'log.csv', head + lines(rows, ['%.1f'] + ['%.6f'] * 3))
    text = ' '.join(run_tool('check', 'log.csv').stdout.split())
    options = shlex.split(text[text.index('--columns') :])[:2]
    assert options[1] == 'time=Time [ms]:ms,x=X [g]:g,y=Y [g]:g,z=Z [g]:g'
    assert run_tool('check', 'log.csv', *options).returncode == 0


@pytest.mark.parametrize('name', ['log.npy', 'log.csv'])
def test_an_array_of_numpy_is_read_and_named(run_tool, tmp_path, name) -> None:
    with open(tmp_path / name, 'wb') as file:
        np.save(file, np.column_stack([LOG.time_s, G0_MPS2 * LOG.output_g]))
    columns = 'time=column[0]:s,x=column[1]:mps2,y=column[2]:mps2,z=column[3]:mps2'
    done = run_tool('check', name, '--columns', columns)
    if name == 'log.npy':
        assert done.returncode == 0, done.stdout
    else:
        assert 'is an array of NumPy; name it .npy' in ' '.join(done.stdout.split())


@pytest.mark.parametrize('counts', [1e3, 1e6])
@pytest.mark.parametrize('tool', ['check', 'fit', 'noise', 'diagnose'])
def test_every_tool_refuses_stamps_in_another_unit(run_tool, tmp_path, tool, counts) -> None:
    """A column that says s and counts ms or us: one line, and its options read the log."""
    written(
        tmp_path,
        'log.csv',
        'time_s,ax_mps2,ay_mps2,az_mps2\n'
        + lines([counts * LOG.time_s, *G0_MPS2 * LOG.output_g.T], ['%.0f'] + ['%.4f'] * 3),
    )
    output = [] if tool in ('check', 'noise') else ['-o', 'out.yaml']
    done = run_tool(tool, 'log.csv', *output)
    text = ' '.join((done.stdout + done.stderr).split())
    assert done.returncode == 1
    assert f'time_s has steps of {0.01 * counts:.4g}, which as s are' in text
    unit = 'ms' if counts == 1e3 else 'us'
    assert f"--columns 'time=time_s:{unit},x=ax_mps2:mps2" in text
    options = shlex.split(text[text.index('--columns') :])[:2]
    assert run_tool('check', 'log.csv', *options).returncode == 0


def test_numbered_columns_and_a_mapping_file(run_tool, tmp_path) -> None:
    """A header may be missing, and a file may hold the mapping; `apply` reads both alike."""
    text = lines([1e3 * LOG.time_s, *1e3 * LOG.output_g.T], ['%.0f'] + ['%.1f'] * 3, ';', ',')
    written(tmp_path, 'log.csv', text)
    written(tmp_path, 'columns.txt', '# the board of the lab\ntime=1:ms\nx=2:mg\ny=3:mg, z=4:mg\n')
    for columns, out in (('columns.txt', 'a.csv'), ('time=1:ms,x=2:mg,y=3:mg,z=4:mg', 'b.csv')):
        done = run_tool('apply', 'log.csv', '--columns', columns, '-o', out)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / 'a.csv').read_bytes() == (tmp_path / 'b.csv').read_bytes()
    read = np.genfromtxt(tmp_path / 'a.csv', delimiter=',', names=True)
    np.testing.assert_allclose(read['ax_mps2'], G0_MPS2 * LOG.output_g[:, 0], atol=1e-3)
    np.testing.assert_allclose(read['time_s'], LOG.time_s, atol=1e-9)


@pytest.mark.parametrize(
    ('text', 'options', 'words'),
    [
        (
            SHORT,
            ['--columns', 'time=t:s,x=x:g,y=y:g,z=w:g'],
            "--columns: log.csv has no column 'w' for z; the columns are t, x, y, z",
        ),
        (
            SHORT,
            ['--columns', 'time=t:s,x=x:foot'],
            "x=x:foot: unknown unit 'foot'; write one of g, ",
        ),
        (SHORT, ['--columns', 'tme=t:s,x=x:g'], "no role 'tme'; the roles are time, x, y"),
        (SHORT, ['--columns', 'x=x:g,y=y:g,z=z:g'], 'has no time; add time=COLUMN:UNIT, or give'),
        (SHORT, ['--columns', 'time=t:s,x=x:lsb,y=y:lsb,z=z:lsb'], 'x is in LSB; add --lsb-per-g'),
        (
            SHORT,
            ['--columns', 'time=t:s,x=x:g,y=y:v'],
            'some axes are in volts and others are not',
        ),
        (
            SHORT,
            ['--columns', 'time=t:s,x=x:g,roll=y:deg'],
            'roll are no reference; name roll and',
        ),
        (
            't,x,y,z,r,p\n' + 20 * '0,0,0,1,90,0\n',
            ['--columns', f'{XYZ_G},roll=r:rad,pitch=p:deg', '--rate', '9'],
            'log.csv:2:5: r is 90, no roll in rad; delete the line, or correct the unit',
        ),
        (
            SHORT,
            ['--columns', NO_SERIAL],
            '--columns: nothing states the unit of x; write for example x=x:mps2',
        ),
        (SHORT, ['--columns', 'gone.txt'], '--columns gone.txt: is neither a mapping nor a file'),
        (SHORT, ['--columns', XYZ_G, '--axes', 'x=-y,y=y'], '--axes x=-y,y=y: each axis of the'),
        (SHORT, ['--columns', XYZ_G, '--lsb-per-g', '4'], '--lsb-per-g: no column is in LSB'),
        (SHORT, ['--columns', XYZ_G, '--rate', '0'], '--rate 0: expected samples a second'),
        (SHORT, ['--topic', '/imu'], '--topic /imu: log.csv is no bag; leave --topic out'),
        (
            SHORT.replace('-0.02,1.002', 'off,1.002', 1),
            ['--columns', XYZ_G],
            "log.csv:4:3: y is 'off', not a number",
        ),
        ('name,state\na,b\nc,d\n', [], 'log.csv: the first 200 lines hold no row of numbers'),
        ('height,width\n1,2\n3,4\n', [], 'none looks like an accelerometer: name the columns'),
    ],
)
def test_wrong_input_has_one_line_that_says_what_to_write(
    run_tool, tmp_path, text, options, words
) -> None:
    written(tmp_path, 'log.csv', text)
    done = run_tool('fit', 'log.csv', '-o', 'unit.yaml', *options)
    assert done.returncode == 1 and not (tmp_path / 'unit.yaml').exists()
    assert words in done.stderr and done.stderr.count('\n') == 1, done.stderr


def bag_with(folder: Path, topics: list[str], log: Turned = LOG) -> None:
    stamps = EPOCH_NS + np.rint(1e9 * log.time_s).astype(np.int64)
    bag_of(
        folder / 'bag',
        [
            imu(stamp, force, topic, (0.0, 0.0, 0.0), topic)
            for stamp, force in zip(stamps.tolist(), G0_MPS2 * log.output_g)
            for topic in topics
        ],
    )


def test_several_imu_topics_of_a_bag_are_named(run_tool, tmp_path) -> None:
    bag_with(tmp_path, ['/camera/imu', '/body/imu/data'])
    done = run_tool('fit', 'bag', '-o', 'unit.yaml')
    assert done.returncode == 1
    assert 'choose one with --topic: /body/imu/data, /camera/imu' in done.stderr
    done = run_tool('fit', 'bag', '--topic', 'camera/gyro', '-o', 'unit.yaml')
    assert 'no topics camera/gyro; choose one with --topic: /body/imu/data, ' in done.stderr
    done = run_tool('fit', 'bag', '--topic', 'camera/imu', '-o', 'unit.yaml')
    assert done.returncode == 0, done.stderr
    check_errors(tmp_path / 'unit.yaml')
