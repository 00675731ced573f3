# SPDX-License-Identifier: Apache-2.0

"""The guided calibration: pose plan, dwell, checks of a pose, what is displayed."""
