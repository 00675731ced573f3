# SPDX-License-Identifier: Apache-2.0
"""Validation of adxl_ros: the blind check, working cases, and the experiments of the paper."""
