# SPDX-License-Identifier: Apache-2.0

"""Constants that the whole package shares."""

G0_MPS2 = 9.80665
"""Standard gravity, m/s², exact (ISO 80000-3); the g of every coefficient in V/g or 1/g."""
TINY = 2.2250738585072014e-308  # Smallest normal float64: a divisor that is never 0
FINEST_V = 1e-12  # Step that stands for none, V. Chosen: below the rounding of volts
AXES = 'xyz'  # Axis letters in the order of every array
MEASURED_AXES = ('x', 'xy', 'xyz')  # The axes that a sensor may measure
Z_90 = 1.6449
"""Half of a 90 % interval in standard deviations: the 95 % quantile of the normal distribution."""
MAD_TO_STD = 1.4826
"""Standard deviation of a normal deviate, relative to the median of its magnitude."""
NOMINAL_TEMPERATURE_C = 25.0
"""Temperature of the datasheet values, °C (ADXL203 datasheet, specifications)."""
NOMINAL_SUPPLY_V = 5.0
"""Supply voltage of the datasheet values, V (ADXL203 datasheet, specifications)."""
SAME_ANGLE_RAD = 1e-5
"""Angles that differ by less are equal, rad: above the rounding of angles in a file, and far below
the step of an encoder."""
