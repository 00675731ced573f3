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

"""The end of an executable whose output nobody reads any more, as of `fit --help | head -1`."""

from collections.abc import Iterator
from contextlib import contextmanager
import os
import select
import sys


@contextmanager
def ended_by_closed_output() -> Iterator[None]:
    """End the process with status 1 and without a message when the reader of stdout has ended."""
    try:
        try:
            yield
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except BrokenPipeError:
        if not _is_reader_gone():
            raise
        # Python flushes once more at exit, and would report the pipe then.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _is_reader_gone() -> bool:
    """Return whether stdout is the pipe that broke; a pipe to another process is an error."""
    poll = select.poll()
    poll.register(sys.stdout, 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))
