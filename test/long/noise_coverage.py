# SPDX-License-Identifier: Apache-2.0

"""
How often the 90 % intervals of `noise` hold the truth: docs/measurements/noise_coverage.md.

Run as `make noise`; 200 draws take some minutes.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

from adxl_ros.signals.allan_deviation import CellMeans
from adxl_ros.signals.axis_noise import without_rounding
from adxl_ros.signals.noise_parameters import coefficient_variances, fit_noise
import numpy as np
from scipy.signal import lfilter
from still_noise import still_samples


class Case(NamedTuple):
    """
    Length, s, rate, Hz, and the terms N, B and K of a recording.

    Further: amplitude of a line at 0.55 Hz, step of the codes, and correlation time of the walk.
    """

    time_s: int
    rate_hz: int
    white: float
    instability: float
    walk: float
    line: float = 0.0
    step: float = 0.0
    bound_s: float = 0.0

    def samples(self, rng: np.random.Generator) -> np.ndarray:
        """Return samples, m/s², (n,)."""
        count, walk = self.time_s * self.rate_hz, self.walk if not self.bound_s else 0.0
        drawn = still_samples(rng, count, self.rate_hz, self.white, self.instability, walk)
        drawn += self.line * np.sin(2 * np.pi * 0.55 * np.arange(count) / self.rate_hz
                                    + rng.uniform(0, 2 * np.pi))
        if self.bound_s:
            decay = np.exp(-1 / (self.rate_hz * self.bound_s))
            scale = self.walk * np.sqrt(self.bound_s / 2 * (1 - decay ** 2))
            steps = scale * rng.standard_normal(count)
            steps[0] /= np.sqrt(1 - decay ** 2)
            drawn += lfilter([1.0], [1.0, -decay], steps)
        drawn += rng.uniform(0, 1)
        return np.round(drawn / self.step) * self.step if self.step else drawn

    def describe(self) -> str:
        """Return what is beside the three terms."""
        texts = (f'line {self.line:g}' if self.line else '',
                 f'steps {self.step:g}' if self.step else '',
                 f'T {self.bound_s:g} s' if self.bound_s else '')
        return ''.join(f', {text}' for text in texts if text)


CASES = (
    Case(600, 100, 1e-3, 1e-4, 1e-6),
    Case(3600, 50, 1e-3, 1e-4, 3e-5),
    Case(7200, 20, 1e-3, 2e-4, 1e-5),
    Case(7200, 20, 1e-3, 1e-5, 1e-4),
    Case(20000, 10, 1e-3, 3e-4, 1e-6),
    Case(86400, 5, 1e-3, 1e-4, 3e-6),
    Case(600, 50, 1e-3, 0.0, 0.0, line=5e-3),
    Case(600, 50, 1e-3, 0.0, 0.0, step=0.007),
    Case(600, 50, 1e-3, 0.0, 0.0, step=0.02),
    Case(7200, 10, 1e-3, 0.0, 5e-5, bound_s=100.0),
    Case(7200, 10, 1e-3, 1e-4, 5e-5, bound_s=200.0),
)
"""Recordings of ten minutes to a day. Units are m/s²/√Hz, m/s² and m/s²/√s."""


def row(case: Case, draws: int) -> str:
    """Return the row of a case: in how many draws the interval holds, and the term is seen."""
    inside, seen = np.zeros(3, int), np.zeros(3, int)
    variances = None
    for seed in range(draws):
        cells = CellMeans(1)
        drawn = case.samples(np.random.default_rng(seed))
        cells.feed(drawn[:, None])
        step_s = cells.size / case.rate_hz
        if variances is None:
            variances = coefficient_variances(cells.count, step_s)
        fit = without_rounding(fit_noise(cells.means[:, 0], step_s, variances), drawn.std(),
                               case.step, case.step / np.sqrt(12 * case.rate_hz))
        for term, estimate in enumerate((fit.white, fit.instability, fit.walk)):
            inside[term] += estimate.low <= case[2 + term] <= estimate.high
            seen[term] += estimate.is_seen
    counts = ' | '.join(f'{count} ({there})' for count, there in zip(inside, seen))
    return f'| {case.time_s / 3600:.2g} h, {case.rate_hz} Hz{case.describe()} | {case.white:g}, ' \
           f'{case.instability:g}, {case.walk:g} | {counts} |'


def main() -> None:
    """Print the table."""
    parse = argparse.ArgumentParser(description=__doc__)
    parse.add_argument('--draws', type=int, default=200)
    draws = parse.parse_args().draws
    print('| recording | N, B, K | N inside (seen) | B inside (seen) | K inside (seen) |')
    print('|---|---|---|---|---|')
    for case in CASES:
        print(row(case, draws), flush=True)


if __name__ == '__main__':
    main()
