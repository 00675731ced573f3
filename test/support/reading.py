# SPDX-License-Identifier: Apache-2.0

"""Memory that reading a recording needs, and the messages of its refusals."""

import os
from pathlib import Path
import subprocess
import sys

from adxl_ros.errors import UserError
from adxl_ros.files import recording
import pytest

GROWTH = """
import sys
from tracemalloc import get_traced_memory, start
from adxl_ros.files import recording
start()
peaks = []
for block in recording.blocks(sys.argv[1], 5000):
    peaks.append(get_traced_memory()[1])
print((peaks[-1] - peaks[len(peaks) // 4]) / 1024)
"""
"""Growth of the highest memory that Python and numpy hold, KiB: that of the process has steps of
many MiB, and begins with that of its parent."""


def refusal(path: Path) -> str:
    """Return the message to the user, which is one line and begins with the file."""
    with pytest.raises(UserError) as raised:
        recording.read(path)
    text = str(raised.value)
    assert text.startswith(str(path))
    assert '\n' not in text
    return text.removeprefix(str(path))


def growth_mb(path: Path) -> float:
    """Return the growth of memory after the first blocks of a recording, MB."""
    done = subprocess.run(
        [sys.executable, '-c', GROWTH, path],
        text=True,
        check=True,
        capture_output=True,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)},
    )
    return float(done.stdout) / 1024
