# SPDX-License-Identifier: Apache-2.0
"""The check of simulators in words and tables."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.model.constants import G0_MPS2
from adxl_ros.report.quantities import acceleration_text
from adxl_ros_validation.blind.report import Report, Table
from adxl_ros_validation.simulators import arm
from adxl_ros_validation.simulators.base import Checked, MOVED
import numpy as np


def report(made: Sequence[Checked], left_out: Sequence[str], seed: int) -> Report:
    """Return all tables; the first one is the result."""
    tables = {
        'Verdicts': (['verdict', 'difference, rms', 'named', 'would have shown'], _verdict),
        'What is late, ms': ([*MOVED, 'explained'], _late),
        'After a reset in mid-run, compared with a fresh start': (
            ['length before the first step', 'difference then', 'later'],
            _reset,
        ),
    }
    filled = dict[str, Table]()
    for title, (head, cells) in tables.items():
        rows = [[each.simulator, each.reads, *cells(each)] for each in made]
        filled[title] = ['simulator', 'read by', *head], rows
    return Report(
        'Simulated accelerometers against the joints of their simulators',
        [
            f'{"; ".join(sorted({each.made for each in made}))}; seed {seed}. An arm of three '
            f'joints swings freely for {arm.SECONDS:g} s in steps of {1e3 * arm.STEP_S:g} ms. '
            'Each accelerometer, with a noise of 0.3 mg added, is diagnosed against the joints. '
            'Intervals hold 90 %.',
        ],
        {**filled, 'Left out': (['what, and why'], [[text] for text in left_out])},
    )


def _verdict(checked: Checked) -> list[str]:
    """Return the verdict, the effects that it names, and what would have shown."""
    named, shown = '; '.join(checked.named) or '-', ', '.join(checked.would_show) or '-'
    return [checked.verdict, _mg(checked.left_mg), named, shown]


def _late(checked: Checked) -> list[str]:
    """Return how late each is, and what that explains."""
    ends = list(checked.late_ms.values())
    texts = [
        f'{value:.2f} ({low:.2f} to {high:.2f})' for value, low, high in np.round(ends, 2) + 0
    ]
    return [*texts, f'{100 * checked.explained:.0f} %']


def _reset(checked: Checked) -> list[str]:
    """Return the readings after a reset, in words."""
    length = f'{checked.at_rest_mps2:.3g} m/s²'
    return [length, _mg(checked.at_once_mg), _mg(checked.later_mg)]


def _mg(size: float) -> str:
    """Return a size in mg, in words."""
    return acceleration_text(1e-3 * size * G0_MPS2)
