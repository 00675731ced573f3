# SPDX-License-Identifier: Apache-2.0

"""Quality of a calibration: held-out errors, error budget, acceptance, drift, plots, page."""
