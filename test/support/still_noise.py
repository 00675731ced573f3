# SPDX-License-Identifier: Apache-2.0

"""Noise of known white noise, bias instability and random walk, made apart from the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np

_TIMES_LONGER = 8
"""Length of the drawn 1/f noise, in lengths of the part that is used. Then it has slow motion."""


def still_samples(
    rng: np.random.Generator,
    count: int,
    rate_hz: float,
    white: float,
    instability: float,
    walk: float,
) -> np.ndarray:
    """Return samples (n,) with N in u/√Hz, B in u, and K in u/√s."""
    samples = rng.standard_normal(count) * white * np.sqrt(rate_hz)
    samples += np.cumsum(rng.standard_normal(count)) * walk / np.sqrt(rate_hz)
    return samples + instability * flicker(rng, count)


def flicker(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return 1/f noise (n,) of B = 1, drawn in the frequency domain: the rate does not matter."""
    longer = _TIMES_LONGER * count
    spectrum = np.fft.rfft(rng.standard_normal(longer))
    # The density over both signs of the frequency is B²/(2π·f).
    spectrum[1:] /= np.sqrt(2 * np.pi * np.fft.rfftfreq(longer)[1:])
    spectrum[0] = 0.0
    return np.fft.irfft(spectrum, longer)[:count]


def write_csv(
    path: Path, time_s: np.ndarray, accel_mps2: np.ndarray, **columns: np.ndarray
) -> Path:
    """Write a recording in m/s², (n, m), with further columns."""
    names = ['time_s', *('ax_mps2', 'ay_mps2', 'az_mps2')[: accel_mps2.shape[1]], *columns]
    np.savetxt(
        path,
        np.column_stack([time_s, accel_mps2, *columns.values()]),
        fmt='%.12g',
        delimiter=',',
        header=','.join(names),
        comments='',
    )
    return path
