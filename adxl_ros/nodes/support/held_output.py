# SPDX-License-Identifier: Apache-2.0
"""The output of this process, held back while a terminal shows a screen."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import os
import shutil
import sys
from tempfile import TemporaryFile


@contextmanager
def held_output() -> Iterator[None]:
    """Keep what this process prints, and print it at the end: lines would tear the screen."""
    _flush()
    with TemporaryFile() as file:
        originals = {stream: os.dup(stream) for stream in (1, 2)}
        for stream in originals:
            os.dup2(file.fileno(), stream)
        try:
            yield
        finally:
            _flush()
            for stream, original in originals.items():
                os.dup2(original, stream)
                os.close(original)
            file.seek(0)
            with suppress(OSError):
                shutil.copyfileobj(file, sys.stderr.buffer)
            _flush()


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        # A terminal that has hung up takes nothing.
        with suppress(OSError):
            stream.flush()
