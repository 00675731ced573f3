# SPDX-License-Identifier: Apache-2.0

"""The command-line tools: arguments, progress and messages."""

from adxl_ros.process import use_one_thread

use_one_thread()
