# SPDX-License-Identifier: Apache-2.0

"""The dwell in one pose: the samples since the arrival, and the rests among them."""

from __future__ import annotations

from typing import NamedTuple

from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.noise_limits import datasheet_noise
from adxl_ros.signals.rest_detection import Rest, rest_means, RestFinder, Stillness
import numpy as np


class RestMean(NamedTuple):
    """The average of a rest."""

    # start_ns, stop_ns: Stamps of the first and the last sample, ns
    start_ns: int
    stop_ns: int
    samples: int  # Number of samples
    # mean_v, std_v: Mean output of each axis and the standard deviation of that mean, V, (m,)
    mean_v: tuple[float, ...]
    std_v: tuple[float, ...]


class Dwell:
    """Samples from an arrival on."""

    def __init__(self, sensor: Sensor, arrived_ns: int) -> None:
        self.arrived_ns = arrived_ns
        self._sensor = sensor
        self._finder = RestFinder(sensor.rate_hz, len(sensor.axes), datasheet_noise(sensor),
                                  learn=False)
        self._stamps: list[np.ndarray] = []
        self._volts: list[np.ndarray] = []

    def __len__(self) -> int:
        """Return the number of samples since the arrival."""
        return sum(map(len, self._stamps))

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """
        Take samples.

        stamps_ns: their stamps, ns, (n,); volts: the samples, V, (n, m).
        """
        new = stamps_ns >= self.arrived_ns
        self._stamps.append(stamps_ns[new])
        self._volts.append(volts[new])
        # From the arrival: float64 seconds since 1970 resolve only 0.2 µs.
        self._finder.feed((stamps_ns[new] - self.arrived_ns) * 1e-9, volts[new])

    def rests(self) -> list[Rest]:
        """Return the rests so far; the last one may still go on."""
        return self._finder.rests() if self._stamps else []

    def stillness(self) -> Stillness | None:
        """Return whether the newest samples are at rest; None while they are too few."""
        return self._finder.stillness()

    def at_rest_s(self) -> float:
        """Return for how long the newest rest has lasted, s."""
        rests = self.rests()
        return (rests[-1].stop - rests[-1].start) / self._sensor.rate_hz if rests else 0.0

    def at_rest(self) -> bool:
        """Return whether the newest samples are known to be at rest."""
        stillness = self.stillness()
        return stillness is not None and stillness.at_rest

    def age_s(self) -> float:
        """Return for how long there have been samples, s."""
        return len(self) / self._sensor.rate_hz

    def volts(self, rest: Rest) -> np.ndarray:
        """Return the samples of a rest, V, (n, m)."""
        return np.concatenate(self._volts)[rest.start:rest.stop]

    def mean(self, rest: Rest, samples: int) -> RestMean:
        """Average the first samples of a rest."""
        stamps, start, stop = np.concatenate(self._stamps), rest.start, rest.start + samples
        times = (stamps - self.arrived_ns) * 1e-9
        mean, std = rest_means(times, np.concatenate(self._volts),
                               [Rest(start, stop, times[start], times[stop - 1])],
                               self._sensor.rate_hz, datasheet_noise(self._sensor))
        return RestMean(int(stamps[start]), int(stamps[stop - 1]), samples,
                        tuple(mean[0].tolist()), tuple(std[0].tolist()))
