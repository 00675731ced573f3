# SPDX-License-Identifier: Apache-2.0

"""Poses whose angles a table states, and poses without angles."""

from __future__ import annotations

from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.files.tables import PoseTable
import numpy as np

_SHARE = 0.5
"""Smallest share of a rest that must lie within the span of its pose (chosen: a span that was
noted by hand is not exact)."""


def with_table_angles(poses: Poses, table: PoseTable, epoch_ns: int) -> Poses:
    """Give rests the angles of a table."""
    if table.span_s is None:
        if len(table.angles_rad) != len(poses):
            raise UserError(
                f'{table.path}: has {len(table.angles_rad)} poses, but the recording has '
                f'{len(poses)} rests, which begin at {_starts(poses)}; write a row for each rest '
                '(with empty angles where they are not known), or add the columns start_s and '
                'stop_s')
        angles = table.angles_rad
    else:
        angles = _by_time(poses, table, table.span_s - epoch_ns * 1e-9)
        if np.isnan(angles).any(axis=1).all():
            raise UserError(f'{table.path}: no pose lies at a rest of the recording; the rests '
                            f'begin at {_starts(poses)}')
    return Poses(poses.volts, poses.std_v, angles[:, 0], angles[:, 1], poses.time_s, poses.check,
                 poses.temperature_c, poses.supply_v)


def _by_time(poses: Poses, table: PoseTable, span_s: np.ndarray) -> np.ndarray:
    """Return the angles of each rest, (k, 2), by the times of the poses."""
    angles = np.full((len(poses), 2), np.nan)
    for (start_s, stop_s), pose in zip(span_s, table.angles_rad):
        shared_s = np.minimum(poses.time_s[:, 1], stop_s) - np.maximum(poses.time_s[:, 0], start_s)
        length_s = np.diff(poses.time_s, axis=1)[:, 0] if stop_s > start_s else 0.0
        angles[shared_s >= _SHARE * length_s] = pose
    return angles


def _starts(poses: Poses) -> str:
    return ', '.join(f'{start_s:.1f}' for start_s in poses.time_s[:, 0]) + ' s'


def has_angles(poses: Poses) -> np.ndarray:
    """Return which poses have both angles, (k,) bool."""
    return np.isfinite(poses.alpha_rad) & np.isfinite(poses.beta_rad)
