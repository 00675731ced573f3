# SPDX-License-Identifier: Apache-2.0

"""
Limits of processor time that also hold on a slow or busy core.

A limit is stated for a core that does the standard work in a tenth of a second. The speed of this
core is measured before and after the work that is limited.
"""

from contextlib import contextmanager
import time

import numpy as np

STANDARD_S = 0.1
"""Processor time of the standard work on the core for which limits are stated, s."""


def standard_work():
    """Do some work of fits and simulations; return its processor time, s."""
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
    """Fail where the work in this block takes longer than the limit of a standard core, s."""
    before = standard_work()
    began = time.process_time()
    yield
    used = time.process_time() - began
    slower = max(before, standard_work()) / STANDARD_S
    assert used / slower < limit_s, f'{used:.2f} s on a core {slower:.2f} times slower'
