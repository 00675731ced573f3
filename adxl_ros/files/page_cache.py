# SPDX-License-Identifier: Apache-2.0

"""What a large file leaves in the page cache of the system."""

from __future__ import annotations

import os
from typing import BinaryIO

_KEPT_BYTES = 256 << 20
"""Part of a file that stays in the cache for whoever reads it next (chosen)."""
_LARGE_BYTES = 2 << 30
"""Size from which a file that is read leaves the cache (chosen): smaller ones are read again."""


def release_read(file: BinaryIO) -> None:
    """Give back the page cache of what was read of a large file, up to the present place."""
    if os.fstat(file.fileno()).st_size > _LARGE_BYTES:
        # From its begin on, because the system keeps a large page that is only partly within.
        os.posix_fadvise(file.fileno(), 0, file.tell(), os.POSIX_FADV_DONTNEED)


def release_written(file: BinaryIO) -> None:
    """
    Give back the page cache of what was written, but for the newest 256 MB.

    The system writes it to the disk and uses the same memory for what follows. Without this, a
    file of 13 GB pushes out what other programs have in the cache. Where memory is virtual, its
    first use takes most of the time of writing.
    """
    end = file.tell() - _KEPT_BYTES
    if end > 0:
        os.posix_fadvise(file.fileno(), 0, end, os.POSIX_FADV_DONTNEED)
