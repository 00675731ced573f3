# SPDX-License-Identifier: Apache-2.0
"""
Measure the tilt error of a hand-held calibration against its number of rests.

    ./run --exec python docs/measurements/hand_held.py > docs/measurements/hand_held.txt

Units of `lsm6dso` are drawn. Each rests in 40 random directions (`simulate tumble`), of which the
first ones are fitted. The errors are those of 40 other rests of the same unit, after `~/level`,
which takes out roll and pitch of the mounting, and leaves its yaw.
"""

from datetime import date
from pathlib import Path
import re
import subprocess
import sys
import tempfile

from adxl_ros.process import package_version
import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

UNITS = 12
RESTS = (14, 18, 24, 40)
RUN = Path(__file__).resolve().parents[2] / 'run'


def tool(*words: object) -> None:
    """Run a tool of the package; one that fails ends this program."""
    made = subprocess.run([RUN, *map(str, words)], capture_output=True, text=True)
    if made.returncode:
        sys.exit(made.stderr)


def rests_of(table: pd.DataFrame) -> list[tuple[int, int]]:
    """Return first and last row of each rest: alpha and beta stand still."""
    still = (table['alpha_rad'].diff().abs() + table['beta_rad'].diff().abs() < 1e-5).to_numpy()
    edges = np.flatnonzero(np.diff(np.r_[False, still, False].astype(int)))
    return [(a, b) for a, b in edges.reshape(-1, 2) if b - a > 2 / np.diff(table['time_s'])[0]]


def error_deg(truth: pd.DataFrame, corrected: pd.DataFrame) -> float:
    """Return the rms angle between true and levelled vertical over the rests, degrees."""
    true, measured = [], []
    for first, last in rests_of(truth):
        alpha, beta = truth[['alpha_rad', 'beta_rad']].iloc[(first + last) // 2]
        true.append([np.sin(alpha) * np.cos(beta), -np.sin(alpha) * np.sin(beta), np.cos(alpha)])
        mean = corrected[['ax_mps2', 'ay_mps2', 'az_mps2']].iloc[first:last].mean()
        measured.append(mean / np.linalg.norm(mean))
    to_case, _ = Rotation.align_vectors(measured, true)
    levelled = levelling(to_case.apply([0, 0, 1])).apply(measured)
    cosine = np.sum(levelled * np.array(true), axis=1)
    return float(np.degrees(np.sqrt(np.mean(np.arccos(np.clip(cosine, -1, 1)) ** 2))))


def levelling(vertical: np.ndarray) -> Rotation:
    """Return the roll and pitch that turn the vertical of a level robot upright."""
    x, y, z = vertical
    roll, pitch = np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))
    return Rotation.from_euler('xy', [roll, pitch])


def unit_errors(seed: int, folder: Path) -> dict[int, float]:
    """Return the error of one drawn unit by number of rests; 0 without a calibration."""
    draw = np.random.default_rng(seed).normal
    words = []
    for name, size in (
        ('bias:offset_v', 0.03),
        ('scale_factor:offset_v_per_g', 0.02),
        ('misalignment:alpha_rad', 0.0175),
        ('cross_axis:linear', 0.01),
    ):
        effect, parameter = name.split(':')
        values = ','.join(f'{parameter}.{axis}={draw() * size:.6g}' for axis in 'xyz')
        words += ['--effect', f'{effect}:{values}']
    params = folder / 'unit.yaml'
    nominal = (RUN.parent / 'params' / 'lsm6dso.yaml').read_text('utf-8')
    params.write_text(re.sub('resolution_rad: .*', 'resolution_rad: 1.0e-6', nominal), 'utf-8')
    for name, noise in (('fitted', seed), ('other', seed + 1000)):
        tool(
            'simulate',
            'tumble',
            '--params',
            params,
            *words,
            '--rate',
            104,
            '--seed',
            noise,
            '-o',
            folder / f'{name}.csv',
        )
    truth, whole = (pd.read_csv(folder / f'{n}.csv', comment='#') for n in ('other', 'fitted'))
    head = [
        line
        for line in (folder / 'fitted.csv').read_text('utf-8').splitlines()
        if line.startswith('#')
    ]
    ends = [last for _, last in rests_of(whole)]
    errors = {}
    for count in (0, *RESTS):
        used = params
        if count:
            part = whole.iloc[: ends[min(count, len(ends)) - 1]]
            kept = part[['time_s', 'x_v', 'y_v', 'z_v']]
            path, used = folder / 'part.csv', folder / 'fit.yaml'
            path.write_text('\n'.join(head) + '\n' + kept.to_csv(index=False), 'utf-8')
            tool('fit', path, '--params', params, '--store', '', '-o', used)
        tool('apply', folder / 'other.csv', '--params', used, '-o', folder / 'out.csv')
        errors[count] = error_deg(truth, pd.read_csv(folder / 'out.csv', comment='#'))
    return errors


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as folder:
        found = pd.DataFrame([unit_errors(seed, Path(folder)) for seed in range(UNITS)])
    print(
        f'# ./run --exec python docs/measurements/hand_held.py, {date.today()}, '
        f'adxl_ros {package_version()}\n'
        f'# {UNITS} units of lsm6dso, seeds 0 to {UNITS - 1}; rms tilt error on 40 other rests, '
        'degrees\nrests,median,worst'
    )
    for count in found.columns:
        print(f'{count},{found[count].median():.3f},{found[count].max():.3f}')


if __name__ == '__main__':
    sys.exit(main())
