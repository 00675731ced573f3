# SPDX-License-Identifier: Apache-2.0

"""A calibration that is kept up to date by the rests of a sensor at work."""
