# SPDX-License-Identifier: Apache-2.0

"""From rests to coefficients: poses, fits, guided calibration and report."""
