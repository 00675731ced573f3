# SPDX-License-Identifier: Apache-2.0

"""
Tilt of simulated robots that drive, with the filter of robot_localization and without.

    ./run --exec python docs/measurements/tilt_in_motion.py --robot-localization SOURCE
    ... --eigen /usr/include/eigen3 --drives 3 --seed 100 -o /tmp/tilt.md

The robots are those of `adxl_ros_validation.driving_robots`. SOURCE is a checkout of
https://github.com/cra-ros-pkg/robot_localization, branch ros2; g++ compiles its class Ekf, which
then runs with the parameters of launch/ekf.yaml.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import ctypes
from dataclasses import replace
from datetime import date
from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory
from typing import NamedTuple

from adxl_ros.files.atomic_write import write_text
from adxl_ros.model.constants import Z_90
from adxl_ros.process import package_version
from adxl_ros_validation.blind.report import markdown_table
from adxl_ros_validation.driving_robots import KINDS, measure, Measured
import numpy as np
import yaml

HERE = Path(__file__).parent
HEAD = ('tilt', 'rms', 'worst', 'inside, driving', 'inside, at rest')
DEFAULT_NOISE = {3: 0.03, 4: 0.03, 9: 0.01, 10: 0.01, 11: 0.02}
"""What robot_localization takes for roll, pitch and the rates where nothing is given."""
SETTLED_S = 2.0  # Time that the filter has to begin, s


class Tilt(NamedTuple):
    """Roll and pitch, rad, with their variances, rad², (n, 2) each."""

    angle_rad: np.ndarray
    variance_rad2: np.ndarray


class Score(NamedTuple):
    """How wrong the tilt of a drive is."""

    rms_deg: float  # While the robot drives
    worst_deg: float  # The same
    inside: float  # Share of its angles in their 90 % interval
    inside_at_rest: float  # The same at rest


def compiled(source: Path, eigen: str, folder: str) -> ctypes.CDLL:
    """Compile the filter of robot_localization."""
    own, library = HERE / 'robot_localization', Path(folder) / 'filter.so'
    sources = [source / 'src' / f'{name}.cpp' for name in ('ekf', 'filter_base')]
    includes = [f'-I{path}' for path in (own, source / 'include', eigen)]
    subprocess.run(
        ['g++', '-std=c++17', '-O2', '-shared', '-fPIC', *includes, own / 'filter.cpp', *sources]
        + [source / 'src' / 'filter_utilities.cpp', '-o', library],
        check=True,
    )
    return ctypes.CDLL(str(library))


def join(library: ctypes.CDLL, robot: Measured, given: np.ndarray, noise: np.ndarray) -> Tilt:
    """Join the tilt of a drive, with the variances that are given, and the gyroscope."""
    stamp_ns = np.rint((robot.time_s + 1.0) * 1e9).astype(np.int64)
    measured = np.column_stack([robot.tilt_rad, robot.rate_radps])
    rate_variance = np.full(robot.rate_radps.shape, robot.rate_variance)
    variance = np.column_stack([given, rate_variance])
    estimate = np.zeros((len(stamp_ns), 4))
    arrays = (stamp_ns, measured, variance, noise, estimate)
    library.run(len(stamp_ns), *(ctypes.c_void_p(array.ctypes.data) for array in arrays))
    return Tilt(estimate[:, :2], estimate[:, 2:])


def check(library: ctypes.CDLL) -> None:
    """Compare the filter with closed forms."""
    count = 400
    flat, rates = np.zeros((count, 2)), np.tile([0.1, 0.0, 0.0], (count, 1))
    still = Measured(
        time_s=np.arange(count) / 100,
        tilt_rad=flat,
        variance_rad2=flat + 1e-3,
        resting_rad2=flat + 1e-3,
        rate_radps=0 * rates,
        rate_variance=1e-9,
        true_rad=flat,
        is_driving=np.zeros(count, bool),
    )
    # The variance of a mean of equal measurements.
    mean = join(library, still, still.variance_rad2, np.zeros(15))
    np.testing.assert_allclose(mean.variance_rad2[-1], 1e-3 / count, rtol=0.02)
    # Level samples of a robot that turns: the roll is the integral of its rate less the mean.
    turning = replace(still, rate_radps=rates)
    turned = join(
        library, turning, still.variance_rad2, np.r_[np.zeros(9), [1e3] * 3, np.zeros(3)]
    )
    np.testing.assert_allclose(turned.angle_rad[-1, 0], 0.05 * turning.time_s[-1], rtol=0.01)


def score(robot: Measured, tilt: Tilt) -> Score:
    """Compare a tilt with the truth."""
    error_deg = np.degrees(np.abs(tilt.angle_rad - robot.true_rad))
    inside = error_deg <= Z_90 * np.degrees(np.sqrt(tilt.variance_rad2))
    moves = robot.is_driving
    rests = ~moves & (robot.time_s > SETTLED_S)
    driving_deg = error_deg[moves]
    return Score(
        float(np.sqrt((driving_deg**2).mean())),
        float(driving_deg.max()),
        float(inside[moves].mean()),
        float(inside[rests].mean()),
    )


def row(name: str, scores: list[Score]) -> tuple[str, ...]:
    """Return the row of a table: means of the drives, the rms with its 90 % interval."""
    rms, worst, inside, inside_at_rest = np.array(scores).T
    half = Z_90 * rms.std(ddof=1) / np.sqrt(len(rms))
    return (
        name,
        f'{rms.mean():.2f}° ± {half:.2f}°',
        f'{worst.max():.1f}°',
        f'{100 * inside.mean():.0f} %',
        f'{100 * inside_at_rest.mean():.0f} %',
    )


def methods(library: ctypes.CDLL | None) -> dict[str, Callable[[Measured], Tilt]]:
    """Return what is compared, by name."""
    alone: dict[str, Callable[[Measured], Tilt]] = {
        'alone, not raised': lambda robot: Tilt(robot.tilt_rad, robot.resting_rad2),
        'alone, raised': lambda robot: Tilt(robot.tilt_rad, robot.variance_rad2),
    }
    if library is None:
        return alone
    given = yaml.safe_load((HERE.parents[1] / 'launch' / 'ekf.yaml').read_text())
    noise = np.array(given['/**']['ros__parameters']['process_noise_covariance'])
    default = noise.copy()
    default[list(DEFAULT_NOISE)] = list(DEFAULT_NOISE.values())
    return alone | {
        'filter, not raised': lambda robot: join(library, robot, robot.resting_rad2, noise),
        'filter, raised': lambda robot: join(library, robot, robot.variance_rad2, noise),
        'filter, raised, its default noise': lambda robot: join(
            library, robot, robot.variance_rad2, default
        ),
    }


def main() -> int:
    """Simulate, and write the page."""
    parse = argparse.ArgumentParser(description=__doc__)
    parse.add_argument('--robot-localization', type=Path)
    parse.add_argument('--eigen', default='/usr/include/eigen3')
    parse.add_argument('--drives', type=int, default=20)
    parse.add_argument('--seed', type=int, default=0)
    parse.add_argument('-o', dest='output', default=str(Path(__file__).with_suffix('.md')))
    options = parse.parse_args()
    seeds = range(options.seed, options.seed + options.drives)
    library = None
    if options.robot_localization:
        with TemporaryDirectory() as folder:
            library = compiled(options.robot_localization, options.eigen, folder)
        check(library)
    parts = []
    for name, kind in KINDS.items():
        robots = [measure(kind, seed) for seed in seeds]
        rows = [
            row(method, [score(robot, tilt(robot)) for robot in robots])
            for method, tilt in methods(library).items()
        ]
        parts.append(f'## {name}\n\n{markdown_table(HEAD, rows)}')
        print(parts[-1], flush=True)
    tables = '\n\n'.join(parts)
    write_text(
        options.output,
        f"""# Tilt of simulated robots that drive

{date.today()}, version {package_version()}, `docs/measurements/tilt_in_motion.py`:
{options.drives} drives of two minutes, seeds {seeds.start} to {seeds.stop - 1}, samples at 100 Hz.
Error of roll and pitch while the robot drives: mean rms of the drives with its 90 % interval, and
the worst sample. Then the share of the samples in their 90 % interval.

The robots are those of `driving_robots.py` of the validation. The filter is the class Ekf of
robot_localization with `launch/ekf.yaml`. *Not raised*: the covariance by noise and calibration
alone. *Its default noise*: the process noise that robot_localization has where none is given.

{tables}
""",
    )
    return 0


if __name__ == '__main__':
    sys.exit(main())
