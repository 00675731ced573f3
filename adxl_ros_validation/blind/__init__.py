# SPDX-License-Identifier: Apache-2.0
"""
The blind check of the diagnosis: sealed labels, scores, and another simulator of sensor and stage.

The simulator (`simulator`, `faults`, `motion`, `ideal_observer`) shares nothing with the package
but the names of effects and the recording format: other functional forms for the same physics, a
finer time step, spread of units, noise that drifts, errors of the stage, other manoeuvres, and
effects that the library does not hold.
"""
