# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Limits of processor time that hold on a slow core, too, and beside other work.

They are stated for a core that does the standard work in a tenth of a second. What this core does
is measured beside the work in question, before it and after it.
"""

from contextlib import contextmanager
import time

import numpy as np

STANDARD_S = 0.1


def standard_work():
    """Do a little of what fits and simulations do; return the processor time that it took, s."""
    began = time.process_time()
    matrix = np.sin(np.arange(36000.0)).reshape(1200, 30)
    for _ in range(60):
        q, r = np.linalg.qr(matrix)
        np.linalg.solve(r, q.T @ matrix[:, 0])
    long = np.sin(np.arange(200_000) * 0.1)
    for _ in range(20):
        np.cumsum(np.sin(long))
        np.sort(long[:20_000])
    total = 0
    for number in range(400_000):
        total += number * number % 7
    return time.process_time() - began


@contextmanager
def within(limit_s):
    """Fail where the work in this block takes longer than a standard core's limit."""
    before = standard_work()
    began = time.process_time()
    yield
    used = time.process_time() - began
    slower = max(before, standard_work()) / STANDARD_S
    assert used / slower < limit_s, f'{used:.2f} s on a core {slower:.2f} times slower'
