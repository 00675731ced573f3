# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
How often the 90 % intervals of `noise` hold the truth: the table of docs/noise.md.

Run as `make noise`; 200 draws take some minutes.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

from adxl_ros.signals.allan_deviation import CellMeans
from adxl_ros.signals.noise_parameters import coefficient_variances, fit_noise
import numpy as np
from still_noise import still_samples


class Case(NamedTuple):
    """Length, s, rate, Hz, and the terms N, B and K of a recording."""

    time_s: int
    rate_hz: int
    white: float
    instability: float
    walk: float


CASES = (
    Case(600, 100, 1e-3, 1e-4, 1e-6),
    Case(3600, 50, 1e-3, 1e-4, 3e-5),
    Case(7200, 20, 1e-3, 2e-4, 1e-5),
    Case(7200, 20, 1e-3, 1e-5, 1e-4),
    Case(20000, 10, 1e-3, 3e-4, 1e-6),
    Case(86400, 5, 1e-3, 1e-4, 3e-6),
)
"""Recordings of ten minutes to a day. Units are m/s²/√Hz, m/s² and m/s²/√s."""


def row(case: Case, draws: int) -> str:
    """Return the row of a case: in how many draws the interval holds, and the term is seen."""
    inside, seen = np.zeros(3, int), np.zeros(3, int)
    variances = None
    for seed in range(draws):
        cells = CellMeans(1)
        cells.feed(still_samples(np.random.default_rng(seed), case.time_s * case.rate_hz,
                                 case.rate_hz, *case[2:])[:, None])
        step_s = cells.size / case.rate_hz
        if variances is None:
            variances = coefficient_variances(cells.count, step_s)
        fit = fit_noise(cells.means[:, 0], step_s, variances)
        for term, estimate in enumerate((fit.white, fit.instability, fit.walk)):
            inside[term] += estimate.low <= case[2 + term] <= estimate.high
            seen[term] += estimate.is_seen
    counts = ' | '.join(f'{count} ({there})' for count, there in zip(inside, seen))
    return f'| {case.time_s / 3600:.2g} h, {case.rate_hz} Hz | {case.white:g}, ' \
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
