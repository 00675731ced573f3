# SPDX-License-Identifier: Apache-2.0

"""
Kept calibrations of simulated robots over 60 days: see `adxl_ros_validation.kept_robots`.

    make kept                                        6 robots of each kind, some minutes
    make kept ARGS='--robots 3 --seed 100 -o /tmp/kept.md'
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from datetime import date
from pathlib import Path
import sys

from adxl_ros.files.atomic_write import write_text
from adxl_ros.process import package_version
from adxl_ros_validation.blind.report import markdown_table
from adxl_ros_validation.kept_robots import Kind, Outcome, run
import numpy as np

KEPT_HEAD = ('robots', 'tilt error (rms)', 'inside, % x y z', 'worse', 'false')
KNOCK_HEAD = ('knock', 'size', 'within a day', 'ever', 'adopted after')

_BY_DRIFT = {
    'level': Kind(),
    'lies down': Kind(lies_down=True),
    'slope of 4° for 3 weeks': Kind(place_deg=1.0, weeks_deg=4.0),
    'turned by hand': Kind(is_turned=True),
}
"""Robots that are simulated with the usual drift and with five times of it."""


def _kinds() -> dict[str, Kind]:
    """Return the robots without a knock."""
    kinds = {}
    for name, kind in _BY_DRIFT.items():
        kinds[f'{name}, usual drift'] = kind
        kinds[f'{name}, five times'] = replace(kind, drift=5.0, slope=5.0)
    return kinds | {
        'level, five times by temperature': Kind(slope=5.0),
        'level, ten times by temperature': Kind(slope=10.0),
        'lies down, five times by temperature': Kind(lies_down=True, slope=5.0),
    }


KINDS = _kinds()
"""Robots without a knock."""
KNOCKED = {
    'level, on z': Kind(knock_axis=2),
    'level, on x': Kind(knock_axis=0),
    'lies down, on x': Kind(lies_down=True, knock_axis=0),
    'lies down, on z': Kind(lies_down=True, knock_axis=2),
    'lies down, on x, five times the drift': Kind(
        lies_down=True, knock_axis=0, drift=5.0, slope=5.0
    ),
}
"""Robots with a knock on the 31st day."""
KNOCKS_MG = (3.0, 8.0, 20.0)


def kept_row(name: str, outcomes: list[Outcome]) -> list[str]:
    """Return the row of a kind of robot."""
    days = sum(outcome.days for outcome in outcomes)
    inside = np.sum([outcome.inside for outcome in outcomes], axis=0) / days
    tilt_deg = [
        np.sqrt(np.mean([value**2 for value in values]))
        for values in (
            [outcome.tilt_without_deg for outcome in outcomes],
            [outcome.tilt_with_deg for outcome in outcomes],
        )
    ]
    return [
        name,
        f'{tilt_deg[0]:.3f}° → {tilt_deg[1]:.3f}°',
        ' '.join(f'{100 * share:.0f}' for share in inside),
        f'{sum(outcome.worse for outcome in outcomes)} of '
        f'{sum(outcome.adoptions for outcome in outcomes)}',
        str(sum(outcome.false_changes > 0 for outcome in outcomes)),
    ]


def knock_row(name: str, size_mg: float, outcomes: list[Outcome]) -> list[str]:
    """Return the row of a knock."""
    reported = [outcome.reported_days for outcome in outcomes]
    return [
        name,
        f'{size_mg:g} mg',
        f'{sum(days <= 1 for days in reported)} of {len(reported)}',
        f'{sum(bool(np.isfinite(days)) for days in reported)} of {len(reported)}',
        str(sum(outcome.adoptions_after > 0 for outcome in outcomes)),
    ]


def main() -> int:
    """Simulate, and write the page."""
    parse = argparse.ArgumentParser(description=__doc__)
    parse.add_argument('--robots', type=int, default=6)
    parse.add_argument('--seed', type=int, default=0)
    parse.add_argument('-o', dest='output', default=str(Path(__file__).with_suffix('.md')))
    options = parse.parse_args()
    seeds = range(options.seed, options.seed + options.robots)
    kept, knocked, inside, days = [], [], 0, 0
    for name, kind in KINDS.items():
        outcomes = [run(kind, seed) for seed in seeds]
        kept.append(kept_row(name, outcomes))
        inside += sum(sum(outcome.inside) for outcome in outcomes)
        days += sum(3 * outcome.days for outcome in outcomes)
        print(*kept[-1], sep=' | ', flush=True)
    for name, kind in KNOCKED.items():
        for size_mg in KNOCKS_MG:
            outcomes = [run(replace(kind, knock_mg=size_mg), seed, 45) for seed in seeds]
            knocked.append(knock_row(name, size_mg, outcomes))
            print(*knocked[-1], sep=' | ', flush=True)
    write_text(
        options.output,
        f"""# Kept calibrations of simulated robots

{date.today()}, version {package_version()}, `make kept`, seeds {seeds.start} to
{seeds.stop - 1}: {options.robots} robots a row, 60 days each. The robots follow the model that is
learnt; `kept_robots.py` of the validation says how.

Tilt error of a level robot at the end of each day, by the calibration and by the kept one. Share
of days on which the 90 % interval has the zero-g; of all days and axes it is
{100 * inside / days:.1f} %. Adoptions after which the rests of the next day err more than without.
Robots with a reported change and no knock.

{markdown_table(KEPT_HEAD, kept)}

A knock on day 31: robots that report it within a day, or in the two weeks after it, and robots
that adopt anything after it, of any axis. On a robot that stands level, a knock on x is like a
slope:
it is not seen; whether adoptions hold a part of it was not measured.

{markdown_table(KNOCK_HEAD, knocked)}
""",
    )
    return 0


if __name__ == '__main__':
    sys.exit(main())
