# SPDX-License-Identifier: Apache-2.0

"""The command-line tools: arguments, progress and messages."""

import gc

from adxl_ros.process import use_one_thread

_COLLECTED_AFTER = 50_000
"""New objects after which Python looks for garbage. Chosen: modules that load make none, and its
usual 700 cost 0.15 s of a diagnosis."""

use_one_thread()
gc.set_threshold(_COLLECTED_AFTER)
