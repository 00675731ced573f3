# SPDX-License-Identifier: Apache-2.0
"""
Another simulator of sensor and stage, written without the package's own.

It shares nothing with the library of effects but the names of effects and the recording format:
other functional forms for the same physics, a finer time step, spread of units, noise that
drifts, errors of the stage, other manoeuvres, and effects that the library does not hold.
"""
