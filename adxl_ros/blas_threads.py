# SPDX-License-Identifier: Apache-2.0

"""The number of threads of OpenBLAS, for the executables."""

import os


def use_one_thread() -> None:
    """
    Keep OpenBLAS to one thread, unless the user chooses a number; call it before numpy is loaded.

    The matrices of this package are small. On busy cores the threads of OpenBLAS wait for each
    other: a fit of 614 poses took 35 s of CPU instead of 2 s.
    """
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
