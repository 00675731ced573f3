# SPDX-License-Identifier: Apache-2.0

"""The command-line tools: arguments, progress and messages."""

import atexit
import gc

from adxl_ros.process import use_one_thread

_COLLECTED_AFTER = 300_000
"""New objects after which Python looks for garbage. Chosen: a diagnosis makes fewer and little
garbage, and its usual 700 cost 0.2 s of it."""

use_one_thread()
gc.set_threshold(_COLLECTED_AFTER)
# Nor is any looked for at the end, which takes 0.2 s after a diagnosis.
atexit.register(gc.freeze)
