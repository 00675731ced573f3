# SPDX-License-Identifier: Apache-2.0
"""`benchmark` by a manifest of synthetic recordings, with the method of the documentation."""

import json
from pathlib import Path

from adxl_ros_validation import benchmark_command
from adxl_ros_validation.benchmark import manifest, methods
import numpy as np
from processes import REPO
import pytest
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

RATE_HZ, SECONDS = 25.0, 80.0
MANIFEST = """
sources:
- {name: swing, file: swing.csv, licence: none, known: made for a test, levels: ABC,
   reference: {file: force.csv}, expected: [[scale_factor]],
   read: {columns: 'time=t:ms,x=a:g,y=b:g,z=c:g'}}
- {name: lost, file: lost.csv, licence: none, known: is not there, levels: A}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a recording whose scale factors are 2 % too large, and the method."""
    rng = np.random.default_rng(3)
    time_s = np.arange(0, SECONDS, 1 / RATE_HZ)
    angle, turn = np.sin(0.5 * time_s), 0.3 * time_s
    force_g = np.stack(
        [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1
    )
    noisy_g = 1.02 * force_g + 1e-3 * rng.normal(size=force_g.shape)
    for name, head, first, samples in (
        ('swing.csv', 't,a,b,c', 1e3 * time_s, noisy_g),
        ('force.csv', 'time_s,ax_mps2,ay_mps2,az_mps2', time_s, 9.80665 * force_g),
    ):
        table = np.column_stack([first, samples])
        np.savetxt(tmp_path / name, table, '%.6f', ',', header=head, comments='')
    (tmp_path / 'manifest.yaml').write_text(MANIFEST)
    page = (REPO / 'docs' / 'howto' / 'benchmark.md').read_text('utf-8')
    method = page.split('```python\n')[1].split('```')[0]
    (tmp_path / 'my_method.py').write_text(method)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def benchmark(folder: Path, *options: str) -> dict:
    """Run the command into a new folder; return its figures without times."""
    parse = benchmark_command.parser()
    words = [str(folder), '--manifest', str(folder / 'manifest.yaml'), *options]
    out = folder / f'out{len(list(folder.glob("out*")))}'
    assert benchmark_command.benchmark(parse.parse_args([*words, '-o', str(out)])) == 0
    made = json.loads((out / 'benchmark.json').read_text())
    for answer in [*made['answers'], *made['physical']]:
        del answer['cpu_s']
    assert (out / 'benchmark.html').stat().st_size and (out / 'benchmark.png').stat().st_size
    return made


def test_a_method_from_outside_and_the_same_table_by_the_same_seed(folder, capsys) -> None:
    options = ('--seed', '8', '--trials', '6', '--method', 'always_bias')
    made = benchmark(folder, *options, '--method', 'my_method:method')
    assert 'left out: lost: ' in capsys.readouterr().err
    again = benchmark(folder, *options, '--method', 'my_method:method')
    assert made == again
    assert {trial['recording'] for trial in made['trials']} == {'swing'}
    own, bias = (
        {row['source']: row for row in made['physical'] if row['method'] == name}
        for name in ('my_method.method', 'always_bias')
    )
    # Level B and C: only the method that names the scale factor is right, and closes the gap.
    assert own['swing']['causes'] == ['scale_factor'] and own['swing']['right'] == 'yes'
    assert own['swing']['closed']['value'] > 0.95
    assert bias['swing']['right'] == 'NO' and bias['swing']['closed']['value'] < 0.8
    # Level A: what is said of the untouched part, too, is no sight of a defect.
    defects = {trial['name'] for trial in made['trials'] if trial['effects']}
    answers = [row for row in made['answers'] if row['trial'] in defects]
    assert not any(row['exact'] for row in answers if row['method'] == 'always_bias')


@pytest.mark.parametrize(
    ('entry', 'words'),
    [
        ('{name: a, file: a, licence: b, known: c, levels: D}', 'source 1 (a): levels: D'),
        ('{name: a, file: a, licence: b, known: c, levels: C}', 'needs a `reference`'),
        ('{name: a, file: a, levels: A, licence: b}', "argument: 'known'"),
        ('{name: a, fil: a}', "'fil'"),
    ],
)
def test_a_wrong_manifest_is_answered_in_one_line(entry, words, tmp_path) -> None:
    path = tmp_path / 'manifest.yaml'
    path.write_text(f'sources: [{entry}]')
    with pytest.raises(manifest.UserError) as error:
        manifest.load(path)
    assert words in str(error.value) and '\n' not in str(error.value)


def test_poses_are_a_reference_on_a_clock_and_axes_of_their_own(tmp_path) -> None:
    """A walk in the hand: gravity hardly moves, and the clock of the poses is 3 s behind."""
    time_s = np.arange(0, 60, 0.02)
    rng = np.random.default_rng(5)
    steps = np.cumsum(rng.normal(0, 1, (len(time_s), 3)), axis=0)
    place = 0.01 * np.sin(2 * np.pi * np.array([0.7, 1.1, 1.7]) * time_s[:, None] + 0.02 * steps)
    place = savgol_filter(place, 51, 3, axis=0)
    turn = Rotation.from_rotvec(0.1 * np.sin(0.5 * time_s)[:, None] * [1, 0, 0])
    over = savgol_filter(place, 11, 3, deriv=2, delta=0.02, axis=0) + [0, 0, 9.80665]
    force = turn.inv().apply(over)
    mounted = Rotation.from_euler('zyx', [80, 20, -30], degrees=True).apply(force)
    for name, head, columns in (
        ('a.csv', 'time_s,ax_mps2,ay_mps2,az_mps2', (time_s + 3, mounted)),
        ('b.csv', 'time_s,x_m,y_m,z_m,qx,qy,qz,qw', (time_s, place, turn.as_quat())),
    ):
        np.savetxt(
            tmp_path / name, np.column_stack(columns), '%.8f', ',', header=head, comments=''
        )
    source = manifest.Source(
        name='a', file='a.csv', licence='none', known='made for a test', levels='C',
        reference=manifest.Reference(file='b.csv', poses=True, align=True, turn=True),
    )  # fmt: skip
    (read,), left_out = manifest.read_all([source], tmp_path)
    assert not left_out
    found = np.array([read.force.columns[name] for name in manifest.ACCEL])
    there = np.array([read.recording.columns[name] for name in manifest.ACCEL])
    moved = [np.interp(read.recording.time_s, read.force.time_s, axis) for axis in found]
    spread = np.std(there, axis=1)
    assert (np.std(there - moved, axis=1) < 0.15 * spread).all() and (spread > 0.1).all()


def test_what_is_made_of_a_fetched_file_is_said(tmp_path) -> None:
    source = manifest.Source(
        name='a', file='a.csv', licence='none', known='made for a test', levels='A',
        address='https://host/b.mat', convert='cut -f 1 $FETCHED > $FILE',
    )  # fmt: skip
    _, (text,) = manifest.read_all([source], tmp_path)
    assert text.endswith('fetch https://host/b.mat, then run: cut -f 1 b.mat > a.csv')


def test_the_manifest_of_the_package_is_read() -> None:
    sources = manifest.load(manifest.SHIPPED)
    assert {level for source in sources for level in source.levels} == {'A', 'B', 'C'}
    assert all(len(source.sha256) == 64 for source in sources)


def test_a_method_that_is_not_there() -> None:
    with pytest.raises(manifest.UserError, match='cannot be imported'):
        methods.chosen(['no_module:method'])
