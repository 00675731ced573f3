# SPDX-License-Identifier: Apache-2.0

"""A table of poses: the angles of each rest of a recording, as a person notes them."""

from __future__ import annotations

from dataclasses import dataclass
import os
import re

from adxl_ros.errors import UserError
from adxl_ros.files.column_units import Quantity, unit_in_name, UNITS
from adxl_ros.files.tables import open_table
from adxl_ros.model.kinematics import stage_angles
import numpy as np

_ANGLES = ('alpha', 'beta', 'roll', 'pitch')
"""Begin of the names of columns with angles."""

_LEVEL_RAD = 1e-9
"""Largest sine of alpha at which beta does not matter."""


@dataclass(frozen=True)
class PoseTable:
    """Angles of k poses."""

    path: str  # The file, for messages
    angles_rad: np.ndarray  # Stage angles alpha and beta, rad, (k, 2); NaN where a pose has none
    # First and last time of each pose, s by the clock of the recording, (k, 2); None where the
    # rows are the rests in their order
    span_s: np.ndarray | None


def read_pose_table(path: str | os.PathLike) -> PoseTable:
    """
    Read a table with a row for each pose.

    Its columns are `alpha` and `beta`, or `roll` and `pitch`, each with its unit (`alpha_deg`),
    and `start_s` and `stop_s`, or `time_s`, where the rows are not the rests in their order.
    """
    table = open_table(path)
    columns = {role: name for role in _ANGLES for name in table.names
               if re.match(rf'(?i){role}(\b|_|$)', name)}
    pair = next((pair for pair in (('alpha', 'beta'), ('roll', 'pitch'))
                 if set(pair) <= set(columns)), None)
    if pair is None:
        raise UserError(f'{path}: has no angles of the poses; expected the columns alpha_deg and '
                        f'beta_deg, or roll_deg and pitch_deg; the columns are '
                        f'{", ".join(table.names)}')
    choices: tuple[tuple[str, ...], ...] = (('start_s', 'stop_s'), ('time_s', 'time_s'), ())
    times = next(names for names in choices if set(names) <= set(table.names))
    names = list(dict.fromkeys([columns[role] for role in pair] + [*times]))
    blocks = list(table.blocks(names))
    values = {name: np.concatenate([block.columns[name] for block in blocks]) for name in names}
    angles = [_radians(table.path, columns[role], values[columns[role]]) for role in pair]
    if pair == ('roll', 'pitch'):
        angles = list(stage_angles(*angles))
    # At alpha 0 and 180 degrees beta does not matter, and people leave its cell empty.
    angles[1] = np.where(np.isnan(angles[1]) & (np.abs(np.sin(angles[0])) < _LEVEL_RAD), 0.0,
                         angles[1])
    return PoseTable(table.path, np.column_stack(angles),
                     np.column_stack([values[name] for name in times]) if times else None)


def _radians(path: str, name: str, values: np.ndarray) -> np.ndarray:
    """Return a column of angles in radians, by the unit in its name."""
    unit = unit_in_name(name, Quantity.ANGLE)
    if unit is None:
        raise UserError(f'{path}: column {name} states no unit; name it {name}_deg or {name}_rad')
    return UNITS[Quantity.ANGLE][unit].convert(values)
