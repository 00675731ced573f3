# SPDX-License-Identifier: Apache-2.0

"""The record of changes on disk: one line of JSON each, synced before it is reported."""

from __future__ import annotations

from datetime import datetime, UTC
import json
import os
from pathlib import Path

from adxl_ros.errors import UserError
from adxl_ros.monitor.live_gap import GapChange

NAME = 'changes.jsonl'
"""Name of the file."""
_FIRST_UTC_NS = 10 ** 18
"""Earliest stamp that is UTC, ns: September 2001. Chosen: a simulator begins at 0."""


def iso_time(stamp_ns: int) -> str:
    """Return a stamp, ns, as UTC to the second, such as 2026-11-23T05:00:00Z; else in seconds."""
    if stamp_ns < _FIRST_UTC_NS:
        return f'{stamp_ns * 1e-9:.0f} s'
    try:
        return datetime.fromtimestamp(stamp_ns // 10 ** 9, UTC).strftime('%Y-%m-%dT%H:%M:%SZ')
    except (OverflowError, ValueError, OSError):
        return f'{stamp_ns * 1e-9:.0f} s'


def append(folder: Path, change: GapChange, serial: str) -> None:
    """Append a change to the record of a folder."""
    unit = 'mg' if change.quantity == 'mean' else 'ratio'
    line = json.dumps({
        'serial': serial, 'axis': change.axis, 'quantity': change.quantity,
        'size': round(change.size, 6), 'unit': unit, 'since': iso_time(change.since_ns),
        'since_ns': change.since_ns, 'detected_ns': change.detected_ns})
    path = folder / NAME
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            # A line that a power cut has torn ends before the next one.
            size = os.fstat(file).st_size
            torn = size > 0 and os.pread(file, 1, size - 1) != b'\n'
            os.write(file, f'{chr(10) * torn}{line}\n'.encode())
            os.fsync(file)
        finally:
            os.close(file)
    except OSError as error:
        raise UserError(f'{path}: cannot write: {error.strerror}; set output to a folder that '
                        'can be written') from None
