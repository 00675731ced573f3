# SPDX-License-Identifier: Apache-2.0

"""Recordings along the axes of the sensor frame, by a documented mounting."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import replace

from adxl_ros.errors import UserError
from adxl_ros.files.column_mapping import Mounting
from adxl_ros.files.recording_columns import ACCEL, Recording, VOLTS
from adxl_ros.model.constants import AXES
import numpy as np


def mounted(blocks: Iterable[Recording], mounting: Mounting) -> Generator[Recording, None, None]:
    """Turn the blocks of a recording."""
    for block in blocks:
        names = block.sensor_columns
        if len(names) != len(mounting.signs):
            raise UserError(f'--axes: names the axes {AXES[:len(mounting.signs)]}, but '
                            f'{block.path} has {block.axes}')
        outputs = np.column_stack([block.columns[name] for name in names])
        turned = mounting.turn(outputs - _zero(block, mounting)) + _zero(block, mounting)
        yield replace(block, columns={**block.columns, **dict(zip(names, turned.T.copy()))})


def _zero(block: Recording, mounting: Mounting) -> float:
    """Return the output at zero specific force, in the unit of the output."""
    if block.sensor_columns[0] in ACCEL or min(mounting.signs) > 0:
        return 0.0
    zeros = block.stream_info.nominal_values(block.axes).get('nominal_zero_g_v', np.zeros(0))
    if not len(zeros) or np.ptp(zeros) > 0:
        raise UserError(f'--axes: inverts an axis of {block.path}, whose {VOLTS[0]} is in volts '
                        'about an unknown zero; write a line "# nominal_zero_g_v: ..." with the '
                        'same value for each axis, or state the mounting in the parameter file')
    return float(zeros[0])
