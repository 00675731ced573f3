# SPDX-License-Identifier: Apache-2.0

"""The check of one recording, read in blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from adxl_ros.check.findings import assess, Findings
from adxl_ros.errors import one_line, UserError
from adxl_ros.files import recording
from adxl_ros.files.bag_reader import has_log_times, log_times
from adxl_ros.files.column_mapping import ReadingOptions
from adxl_ros.files.recording_columns import Recording, uncalibrated
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.recorded_sensor import load_sensor
from adxl_ros.signals.recording_contents import examine, log_delay

BLOCK_ROWS = 65536
"""Samples that are read at a time (chosen: some MB)."""


def check_recording(path: str, params: str | None, reading: ReadingOptions,
                    show: Callable[[float], None] = lambda done: None) -> Findings:
    """Return the findings of a recording; one that cannot be read is not sound."""
    try:
        delay = None
        if has_log_times(path) and reading.rate_hz is None:
            delay = log_delay(log_times(path, reading.topic))

        def unit_of(block: Recording) -> Sensor:
            sensor = load_sensor(params, block)
            return uncalibrated(sensor, block.stream_info, block.axes, sensor.rate_hz)

        blocks = recording.blocks(path, BLOCK_ROWS, reading)
        contents = examine(_shown(blocks, show), unit_of, delay)
    except UserError as error:
        reason = one_line(error).removeprefix(f'{path}: ')
        return Findings(path, None, (reason,), paste=error.paste)
    return replace(assess(contents), path=path)


def _shown(blocks: Iterator[Recording], show: Callable[[float], None]) -> Iterator[Recording]:
    """Yield blocks, and show how much has been read."""
    for block in blocks:
        yield block
        show(block.done)
