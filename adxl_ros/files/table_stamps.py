# SPDX-License-Identifier: Apache-2.0

"""The stamps of the rows of a table: those of a column, or counted at a rate."""

from __future__ import annotations

from collections.abc import Mapping
import re
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.column_mapping import (
    ColumnMapping,
    drop_samples,
    is_sensor_step,
    Quantity,
    Source,
    TableBlock,
    time_unit_of_step,
    UNITS,
)
from adxl_ros.files.stamp_check import StampCheck
from adxl_ros.files.stamps import describe_bursts, stamped_rate_hz
from adxl_ros.wording import option, pasted
import numpy as np

_TIME_LIMIT_S = 9e9  # Largest magnitude of a time, s: in nanoseconds it fits into 64 bits (9.2e18)
_EPOCH_S = 1e8
"""First time from which times count from 1970, s: three years (chosen: no sensor runs so long)."""
_FEWEST_STAMPS = 8  # Stamps whose steps show their unit. Chosen: a lost sample hides no median
_WHOLE = 1e-3  # Largest distance of a stamp from a whole number by rounding, in its unit


class StampedRows(NamedTuple):
    """The rows of a block with their stamps."""

    time_s: np.ndarray  # Stamps, s, (n,)
    is_kept: np.ndarray  # Which rows are kept as samples, (n,) bool


class CountedStamps:
    """Counts the rows of a table at a rate; used as `StampColumn` is."""

    def __init__(self, rate_hz: float, is_every_row_a_step: bool) -> None:
        self.epoch_ns = 0  # Origin of the stamps, ns
        self._rate_hz = rate_hz
        self._is_every_row_a_step = is_every_row_a_step
        self._steps = 0  # Steps of the sample rate so far

    def __call__(
        self, block: TableBlock, is_row: np.ndarray, is_sample: np.ndarray
    ) -> StampedRows:
        """Stamp a block; a row with a part of a reading, (n,), has a stamp, too."""
        is_step = is_row | self._is_every_row_a_step
        number = self._steps + np.cumsum(is_step) - 1
        self._steps += int(is_step.sum())
        return StampedRows(number / self._rate_hz, is_sample)

    def look_at_first(self, time_s: np.ndarray) -> list[str]:
        """Return remarks on the first stamps: none."""
        return []


class StampColumn:
    """Reads the stamps of the rows of a table from a column."""

    def __init__(
        self, path: str, sources: Mapping[str, Source], check: StampCheck, may_be_epoch: bool
    ) -> None:
        self.epoch_ns: int | None = None  # Origin of the stamps, ns; None before the first sample
        self._path = path
        self._sources = sources  # Columns and units by role
        self._source = sources['time']
        self._unit = UNITS[Quantity.TIME][self._source.unit]
        self._check = check
        self._may_be_epoch = may_be_epoch  # Whether times may count from 1970
        self._begin = 0.0  # Origin of the times in the unit of the stamps

    def __call__(
        self, block: TableBlock, is_row: np.ndarray, is_sample: np.ndarray
    ) -> StampedRows:
        """Read the stamps of a block; only samples, (n,), need one."""
        column = self._source.column
        stamps = block.columns[column]
        block.refuse(
            column,
            is_sample & ~(np.abs(self._unit.convert(stamps)) < _TIME_LIMIT_S),
            f'no time in {self._source.unit} (200 years at most)',
            f'every sample needs a time: give {option(rate="HZ")} to stamp by index, or delete '
            f'the line; {drop_samples()}',
        )
        if self.epoch_ns is None and is_sample.any():
            first_s = float(self._unit.convert(stamps[is_sample][:1])[0])
            self._set_epoch(block.info.get('epoch_ns', '0'), first_s)
        time_s = self._unit.convert(stamps - self._begin)
        is_kept = self._check.increasing(time_s, is_sample, lambda row: block.where(row, column))
        return StampedRows(time_s, is_kept)

    def _set_epoch(self, stated: str, first_s: float) -> None:
        """Take the epoch that a file states, or the first time where it counts from 1970."""
        if not re.fullmatch(r'-?\d{1,18}|-?[1-8]\d{18}', stated):
            raise UserError(f'{self._path}: epoch_ns is {stated!r}, expected whole nanoseconds')
        self.epoch_ns = int(stated)
        counts_from_1970 = self._may_be_epoch and first_s > _EPOCH_S
        if counts_from_1970 and not self.epoch_ns:
            self.epoch_ns = int(first_s) * 1_000_000_000
            self._begin = int(first_s) * self._unit.divisor

    def look_at_first(self, time_s: np.ndarray) -> list[str]:
        """Refuse stamps that are in another unit; return a remark on those in bursts."""
        if len(time_s) <= _FEWEST_STAMPS:
            return []
        self._check_step(time_s)
        bursts = describe_bursts(time_s)
        if not bursts:
            return []
        by_index = f'{option(rate="HZ")} stamps by index'
        return [f'{self._path}: {bursts}; this rate is used, and {by_index}']

    def _check_step(self, time_s: np.ndarray) -> None:
        """Refuse stamps whose steps no sensor has."""
        rate_hz = stamped_rate_hz(time_s)
        stamps = time_s * self._unit.divisor
        is_whole = bool((np.abs(stamps - np.rint(stamps)) < _WHOLE).all())
        if is_sensor_step(1 / rate_hz, is_whole):
            return
        step = self._unit.divisor / rate_hz
        found = (
            f'{self._path}: {self._source.column} has steps of {step:.4g}, which as '
            f'{self._source.unit} are {rate_hz:.6g} Hz'
        )
        keep = f'if that is right, give {option(rate=f"{rate_hz:.6g}")}'
        if is_whole and step == 1:
            keep = f'if it counts samples, give {option(rate="HZ")}'
        unit = time_unit_of_step(step, is_whole)
        if unit == self._source.unit:
            raise UserError(f'{found}; {keep}')
        time = self._source._replace(unit=unit)
        raise UserError(
            f'{found}; {keep}, and if they are {unit}:',
            pasted(columns=str(ColumnMapping({**self._sources, 'time': time}))),
        )
