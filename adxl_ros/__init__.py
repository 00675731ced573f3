# SPDX-License-Identifier: Apache-2.0

"""Driver, calibration, compensation and diagnosis of low-g analog MEMS accelerometers."""
