# SPDX-License-Identifier: Apache-2.0

"""Temperature and supply of a recording's samples, and what is assumed where they are missing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import NOMINAL_ENVIRONMENT
from adxl_ros.report.quantities import column_unit
import numpy as np


@dataclass
class _Quantity:
    """One quantity over the blocks of a recording."""

    nominal: float  # Value where nothing is known
    samples: int = 0  # Samples so far
    unknown: int = 0  # Those before the first value
    missing: int = 0  # Those without a value of their own after the first one
    longest_s: float = 0.0  # Longest time from a value to a sample without one, s
    _last: float = np.nan  # The newest value, and its stamp, s
    _last_s: float = np.nan

    @property
    def is_known(self) -> bool:
        """Whether there is a value."""
        return self.unknown < self.samples

    def filled(self, time_s: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the values, (n,): each holds until the next one, the nominal one before all."""
        is_known = np.isfinite(values)
        rows = np.arange(1, len(values) + 1)
        newest = np.maximum.accumulate(np.where(is_known, rows, 0))
        held = np.concatenate([[self._last], values])[newest]
        held_since_s = time_s - np.concatenate([[self._last_s], time_s])[newest]
        is_unknown = np.isnan(held)
        self.samples += len(values)
        self.unknown += int(is_unknown.sum())
        self.missing += int((~is_known & ~is_unknown).sum())
        self.longest_s = float(np.nanmax(held_since_s, initial=self.longest_s))
        self._last = float(held[-1])
        self._last_s = float(time_s[-1] - held_since_s[-1])
        return np.where(is_unknown, self.nominal, held)


class _Followed(NamedTuple):
    """A surrounding that effects follow."""

    column: str  # Its column
    quantity: _Quantity  # What was read of it
    effects: str  # The effects, as text


@dataclass
class Surroundings:
    """
    Temperature and supply of a recording, block by block.

    Between two values the first one holds, as in the live compensation; before the first value,
    the nominal one.
    """

    _quantities: dict[str, _Quantity] = field(
        default_factory=lambda: {
            name: _Quantity(getattr(NOMINAL_ENVIRONMENT, name))
            for name in ('temperature_c', 'supply_v')
        }
    )

    def __call__(self, block: Recording) -> dict[str, np.ndarray]:
        """Return the values at the samples of a block, (n,) each, by column; never NaN."""
        if not len(block):
            return {}
        missing = np.full(len(block), np.nan)
        return {
            name: quantity.filled(block.time_s, block.columns.get(name, missing))
            for name, quantity in self._quantities.items()
        }

    def assumed(self, effects: Iterable[str]) -> list[str]:
        """Return what is assumed of what the named effects follow, one line each, for people."""
        lines = self._unknown(effects)
        for name, quantity, names in self._followed(effects):
            if quantity.is_known and quantity.unknown:
                lines.append(
                    f'{name} is missing before its first value, in {quantity.unknown} of '
                    f'{quantity.samples} samples: {names} at {quantity.nominal:g} '
                    f'{column_unit(name)} there'
                )
            if quantity.is_known and quantity.missing:
                lines.append(
                    f'{name} is missing in {quantity.missing} of {quantity.samples} '
                    f'samples, for {quantity.longest_s:.3g} s at most: the value before '
                    'holds'
                )
        return lines

    def interpolated(self, effects: Iterable[str]) -> list[str]:
        """Return the same where missing values are interpolated over the whole recording."""
        lines = self._unknown(effects)
        for name, quantity, _ in self._followed(effects):
            missing = quantity.missing + quantity.unknown
            if quantity.is_known and missing:
                lines.append(
                    f'{name} is missing in {missing} of {quantity.samples} samples: it is '
                    'interpolated, and the nearest value holds at the ends'
                )
        return lines

    def _unknown(self, effects: Iterable[str]) -> list[str]:
        """Return what is assumed for the whole recording, one line each."""
        lines = []
        if since_power_on := _followers(effects).get('time_s'):
            lines.append(f'{since_power_on}: as if the sensor was switched on at the first sample')
        for name, quantity, names in self._followed(effects):
            if not quantity.is_known:
                lines.append(
                    f'{name} is not recorded: {names} at {quantity.nominal:g} {column_unit(name)}'
                )
        return lines

    def _followed(self, effects: Iterable[str]) -> Iterator[_Followed]:
        """Yield what the named effects follow."""
        followers = _followers(effects)
        for name, quantity in self._quantities.items():
            if name in followers:
                yield _Followed(name, quantity, followers[name])


def _followers(effects: Iterable[str]) -> dict[str, str]:
    """Return the effects that follow each surrounding, as text by its name."""
    followers: dict[str, list[str]] = {}
    for effect in map(effect_named, effects):
        for name in effect.follows:
            followers.setdefault(name, []).append(effect.name)
    return {name: ', '.join(names) for name, names in followers.items()}


def assumed(recording: Recording, effects: Iterable[str]) -> list[str]:
    """Return what is assumed of the surroundings of a whole recording, one line each."""
    surroundings = Surroundings()
    surroundings(recording)
    return surroundings.interpolated(effects)
