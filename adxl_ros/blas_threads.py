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

"""The number of threads of OpenBLAS, for the executables."""

import os


def use_one_thread() -> None:
    """
    Keep OpenBLAS to one thread, unless the user chooses a number; call it before numpy is loaded.

    The matrices of this package are small. On busy cores the threads of OpenBLAS wait for each
    other: a fit of 614 poses took 35 s of CPU instead of 2 s.
    """
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
