# SPDX-License-Identifier: Apache-2.0

"""Which parts of a wanted range the temperature has passed, and the error to expect there."""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.calibrate.fits.thermal_fit import ThermalFit
from adxl_ros.model.coefficients import parameter_of
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.filters import play
import numpy as np

PARTS = 10
"""Parts of the wanted range that are to be passed in each direction. Chosen: a curve of degree two
is certain between them."""
_STEADY_K = 0.25
"""Change of temperature, K, that is no change of direction. Chosen: above the noise of a
thermometer."""


@dataclass(frozen=True)
class Passed:
    """Parts of the wanted range that the temperature has passed."""

    middles_c: np.ndarray  # Middle of each part, °C, (parts,)
    # warming, cooling: Whether the temperature has passed it in that direction, (parts,) bool
    warming: np.ndarray
    cooling: np.ndarray
    rises: bool  # Whether the temperature rose last

    @property
    def complete(self) -> bool:
        """Return whether all parts are passed in both directions."""
        return bool(self.warming.all() and self.cooling.all())

    def advice(self) -> str:
        """Return what to do next, for people."""
        half_c = (self.middles_c[1] - self.middles_c[0]) / 2
        open_warm, open_cool = self.middles_c[~self.warming], self.middles_c[~self.cooling]
        if self.complete:
            return 'both directions are covered'
        if len(open_warm) and (self.rises or not len(open_cool)):
            if self.rises:
                return f'warm it to {open_warm[-1] + half_c:.0f} °C'
            return (f'cool it to {open_warm[0] - half_c:.0f} °C, then warm it to '
                    f'{open_warm[-1] + half_c:.0f} °C')
        if not self.rises:
            return f'cool it to {open_cool[0] - half_c:.0f} °C'
        return (f'warm it to {open_cool[-1] + half_c:.0f} °C, then cool it to '
                f'{open_cool[0] - half_c:.0f} °C')


def passed(temperatures_c: np.ndarray, range_c: tuple[float, float]) -> Passed:
    """
    Return which parts of a range the temperature has passed.

    temperatures_c: temperatures in the order of time, °C, (k,).
    """
    low_c, high_c = range_c
    middles_c = low_c + (high_c - low_c) * (np.arange(PARTS) + 0.5) / PARTS
    steady_c = play(np.asarray(temperatures_c, float), _STEADY_K, {})
    before_c, after_c = steady_c[:-1, None], steady_c[1:, None]
    warming = ((before_c < middles_c) & (middles_c <= after_c)).any(axis=0)
    cooling = ((after_c <= middles_c) & (middles_c < before_c)).any(axis=0)
    changes = np.diff(steady_c)
    changes = changes[changes != 0]
    rises = bool(not len(changes) or changes[-1] > 0)
    return Passed(middles_c, np.asarray(warming), np.asarray(cooling), rises)


def expected_error_mg(fit: ThermalFit, covered: Passed, calibrated_c: float) -> float:
    """
    Return the expected error of the zero-g of the worst axis at the worst part of a range.

    A part that is not passed in both directions may have a loop of typical width.
    """
    typical_g = parameter_of(Coefficient('thermal_hysteresis', 'half_width_g', 'x')).scale
    unseen_g = np.where(covered.warming & covered.cooling, 0.0, typical_g)
    return 1e3 * float(np.hypot(fit.error_g(covered.middles_c, calibrated_c), unseen_g).max())
