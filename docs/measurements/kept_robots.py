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

from adxl_ros.calibrate.keep.keeper import NORMAL_90
from adxl_ros.files.atomic_write import write_text
from adxl_ros.model.constants import AXES
from adxl_ros.process import package_version
from adxl_ros_validation.blind.report import markdown_table
from adxl_ros_validation.kept_robots import Kind, Outcome, run
import numpy as np
import scipy

KEPT_HEAD = ('robots', 'tilt error (rms)', 'inside, % x y z', 'all', 'worse', 'false')
KNOCK_HEAD = ('robots, axis', 'rest on that side', 'within a day', 'ever', 'learnt')

WAYS = {
    'level': Kind(),
    'lies down': Kind(lies_down=True),
    'slope of 4° for 3 weeks': Kind(place_deg=1.0, weeks_deg=4.0),
    'turned by hand': Kind(is_turned=True),
}
DRIFTS = {'usual drift': 1.0, 'five times': 5.0}
KINDS = {
    f'{name}, {text}': replace(kind, drift=factor, slope=factor)
    for name, kind in (WAYS | {'two axes, lies down': Kind(lies_down=True, axes='xy')}).items()
    for text, factor in DRIFTS.items()
} | {
    'level, five times by temperature': Kind(slope=5.0),
    'level, ten times by temperature': Kind(slope=10.0),
    'lies down, five times by temperature': Kind(lies_down=True, slope=5.0),
}
"""Robots without a knock."""
KNOCKED = {
    f'{name}, {text}, {AXES[axis]}': replace(kind, drift=factor, slope=factor, knock_axis=axis)
    for name, kind in WAYS.items()
    for text, factor in DRIFTS.items()
    for axis in (0, 2)
}
"""Robots with a knock on the 31st day."""
KNOCKS_MG = (3.0, 8.0, 20.0)


def kept_row(name: str, outcomes: list[Outcome]) -> list[str]:
    """Return the row of a kind of robot."""
    inside = np.array([outcome.inside for outcome in outcomes]) / outcomes[0].days
    by_robot = inside.mean(axis=1)
    # Days of a robot are no independent draws; robots are.
    half = NORMAL_90 * by_robot.std(ddof=1) / np.sqrt(len(by_robot))
    tilt_deg = [
        np.sqrt(np.mean(np.square(values)))
        for values in (
            [outcome.tilt_without_deg for outcome in outcomes],
            [outcome.tilt_with_deg for outcome in outcomes],
        )
    ]
    return [
        name,
        f'{tilt_deg[0]:.3f}° → {tilt_deg[1]:.3f}°',
        ' '.join(f'{100 * share:.0f}' for share in inside.mean(axis=0)),
        f'{100 * by_robot.mean():.0f} ± {100 * half:.0f}',
        f'{sum(outcome.worse for outcome in outcomes)} of '
        f'{sum(outcome.adoptions for outcome in outcomes)}',
        str(sum(outcome.false_changes > 0 for outcome in outcomes)),
    ]


def knock_row(name: str, by_size: list[list[Outcome]]) -> list[str]:
    """Return the row of a knock of several sizes."""
    shown, within, ever, learnt = 0, [], [], []
    for outcomes in by_size:
        could = [outcome for outcome in outcomes if outcome.could_show]
        shown = len(could)
        within.append(sum(outcome.reported_days <= 1 for outcome in could))
        ever.append(sum(bool(np.isfinite(outcome.reported_days)) for outcome in outcomes))
        learnt.append(sum(outcome.is_learnt for outcome in outcomes))
    counts = [' '.join(map(str, found)) for found in (within, ever, learnt)]
    return [name, f'{shown} of {len(by_size[0])}', *counts]


def main() -> int:
    """Simulate, and write the page."""
    parse = argparse.ArgumentParser(description=__doc__)
    parse.add_argument('--robots', type=int, default=6)
    parse.add_argument('--seed', type=int, default=0)
    parse.add_argument('-o', dest='output', default=str(Path(__file__).with_suffix('.md')))
    options = parse.parse_args()
    seeds = range(options.seed, options.seed + options.robots)
    kept, knocked, inside, worse = [], [], [], np.zeros(2, int)
    for name, kind in KINDS.items():
        outcomes = [run(kind, seed) for seed in seeds]
        kept.append(kept_row(name, outcomes))
        inside += [np.mean(outcome.inside) / outcome.days for outcome in outcomes]
        worse += np.sum([(outcome.worse, outcome.adoptions) for outcome in outcomes], axis=0)
        print(*kept[-1], sep=' | ', flush=True)
    for name, kind in KNOCKED.items():
        by_size = []
        for size_mg in KNOCKS_MG:
            by_size.append([run(replace(kind, knock_mg=size_mg), seed, 45) for seed in seeds])
        knocked.append(knock_row(name, by_size))
        print(*knocked[-1], sep=' | ', flush=True)
    upper = scipy.stats.binomtest(*worse.tolist()).proportion_ci(0.9).high
    given = f'--robots {options.robots} --seed {options.seed}'
    write_text(
        options.output,
        f"""# Kept calibrations of simulated robots

{date.today()}, version {package_version()}, `make kept ARGS='{given}'`.
{options.robots} robots a row, 60 days each. The robots follow the model that is learnt;
`kept_robots.py` of the validation says how.

Tilt error of a level robot at the end of each day, by the calibration and by the kept one. Share
of days on which the 90 % interval has the zero-g, by axis, and of all axes with what the scatter
of the robots allows (90 %); of all robots it is {100 * np.mean(inside):.1f} %.
Adoptions after which the rests of the next day err more than without: {worse[0]} of {worse[1]}, at
most {100 * upper:.1f} % (95 %). Robots with a reported change and no knock.

{markdown_table(KEPT_HEAD, kept)}

The interval is true on average over units that drift 1 to 6 times as strongly as stated. Where
rests show how strongly, it is about true for each of them. Where they hardly do, as for two axes,
whose long stays alone show it, it first takes them for equally likely. So it is wide for the usual
drift, and narrow for five times of it: 2·Φ(1.645 · √14.4 / 5) − 1 = 79 % inside.

A knock of 3, 8 and 20 mg on day 31. Robots that rest within a day with that axis up or down; those
of them that report it within a day; robots that report it in two weeks; robots that adopt more
than half of it.

{markdown_table(KNOCK_HEAD, knocked)}

A knock is reported where drift since the last rest on that side does not explain it, d days
before: above 1.6 mg·√d for a unit of the usual drift, which may begin to drift six times as
strongly, and above 5.7 mg·√d for one that does. A level robot cannot show a knock on x. Its rests
show it as a drift of weeks where the ground slopes, and it is not adopted.
""",
    )
    return 0


if __name__ == '__main__':
    sys.exit(main())
