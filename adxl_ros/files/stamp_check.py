# SPDX-License-Identifier: Apache-2.0

"""Samples whose stamp does not increase."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.stamps import describe_bursts
from adxl_ros.wording import option
import numpy as np


class BadStamps(NamedTuple):
    """Samples whose stamp does not increase."""

    duplicates: int  # Samples with the stamp of the sample before
    backward: int  # Samples whose stamp is earlier

    @property
    def texts(self) -> list[str]:
        """Return how many there are of each kind, for people."""
        kinds = ('samples with the stamp of the one before', 'samples whose stamp steps back')
        return [f'{kind}: {count}' for kind, count in zip(kinds, self) if count]


class StampCheck:
    """Finds samples whose stamp does not increase: they are refused, or left out and counted."""

    def __init__(self, path: str, may_drop: bool) -> None:
        self.bad = BadStamps(0, 0)  # What was left out so far
        self._path = path
        self._may_drop = may_drop
        self._last_s = -np.inf

    def increasing(
        self, time_s: np.ndarray, is_sample: np.ndarray, where: Callable[[int], str]
    ) -> np.ndarray:
        """Return which samples among rows, (n,), increase; `where` names the place of a row."""
        latest = np.maximum.accumulate(
            np.concatenate([[self._last_s], np.where(is_sample, time_s, -np.inf)])
        )
        self._last_s = latest[-1]
        latest = latest[:-1]
        wrong = is_sample & ~(time_s > latest)
        stands = wrong & (time_s == latest)
        if wrong.any() and not self._may_drop:
            row = int(wrong.argmax())
            early_s = latest[row] - time_s[row]
            fault = f'time runs backwards, {early_s:.3g} s before the newest sample'
            if stands[row]:
                fault = 'time stands still'
            clauses = (
                fault,
                describe_bursts(time_s[is_sample]),
                f'{option(drop_bad_stamps=True)} leaves such samples out, {option(rate="HZ")} '
                'stamps by index',
            )
            raise UserError(f'{where(row)}: {"; ".join(filter(None, clauses))}')
        duplicates = int(stands.sum())
        self.bad = BadStamps(
            self.bad.duplicates + duplicates, self.bad.backward + int(wrong.sum()) - duplicates
        )
        return is_sample & ~wrong

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return what was left out, for people."""
        return tuple(f'{self._path}: left out, {text}' for text in self.bad.texts)
