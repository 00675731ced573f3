# SPDX-License-Identifier: Apache-2.0

"""Times of the samples of a bag by their header and by the recorder."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import struct

from adxl_ros.errors import UserError
from adxl_ros.files.bag_messages import open_bag
from adxl_ros.files.bag_topics import find_topics
import numpy as np

_STAMP = {0: struct.Struct('>iI'), 1: struct.Struct('<iI')}
"""Seconds and nanoseconds at the begin of a header, by the lowest bit of the CDR identifier."""

_STAMP_BYTE = 4
"""Place of the stamp, after the identifier (DDSI-RTPS, 10.2)."""

_ROWS = 65536
"""Messages of a block (chosen: some MB)."""


def has_log_times(path: str | os.PathLike) -> bool:
    """Return whether a recording is a bag."""
    return Path(path).is_dir() or Path(path).suffix in ('.mcap', '.db3')


def log_times(path: str | os.PathLike, topic: str) -> Iterator[np.ndarray]:
    """
    Read header stamp and log time of the samples of a bag in blocks.

    yields: header stamp and log time by message, ns, (k, 2).
    """
    with open_bag(path) as bag:
        imu = find_topics(bag, topic).imu
        times: list[tuple[int, int]] = []
        for _, raw, log_ns in bag.logged_messages([imu]):
            try:
                seconds, nanoseconds = _STAMP[raw[1] & 1].unpack_from(raw, _STAMP_BYTE)
            except (IndexError, struct.error):
                raise UserError(f'{bag.path}: topic {imu}: a message is damaged: it ends before '
                                'its stamp') from None
            times.append((seconds * 1_000_000_000 + nanoseconds, log_ns))
            if len(times) == _ROWS:
                yield np.array(times)
                times = []
        if times:
            yield np.array(times)
