# SPDX-License-Identifier: Apache-2.0

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
