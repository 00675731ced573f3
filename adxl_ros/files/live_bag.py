# SPDX-License-Identifier: Apache-2.0

"""A bag that is written while its messages come, and is whole up to the last second."""

from __future__ import annotations

from pathlib import Path
import threading
from typing import Any

from adxl_ros.files.bag_messages import import_rosbags
from adxl_ros.files.bag_topics import typestore

_FLUSH_NS = 500_000_000
"""Time after which messages are written to the file, ns. Chosen: what a kill loses."""


class LiveBag:
    """
    Writes serialized messages of any topics into a rosbag2 directory, as they come.

    A reader, or a kill, finds all messages but those of the last half second. Threads may share
    it. Unlike `BagWriter`, it appears under its name at once.
    """

    def __init__(self, path: Path) -> None:
        """Open a new bag."""
        rosbag2 = import_rosbags()
        self._types = typestore()
        self._writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        self._writer.open()
        self._connections: dict[str, Any] = {}
        self._flushed_ns = 0
        self._lock = threading.Lock()
        self._is_open = True

    def write(self, topic: str, kind: str, data: bytes, time_ns: int) -> None:
        """Append a message; one that comes after the end is left out."""
        with self._lock:
            if not self._is_open:
                return
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(topic, kind,
                                                                       typestore=self._types)
            self._writer.write(self._connections[topic], time_ns, data)
            if time_ns - self._flushed_ns > _FLUSH_NS:
                self._flush()
                self._flushed_ns = time_ns

    def close(self) -> None:
        """Write the end of the bag."""
        with self._lock:
            if self._is_open:
                self._is_open = False
                self._writer.close()

    def flush(self) -> None:
        """Write the messages so far to the file."""
        with self._lock:
            if self._is_open:
                self._flush()

    def _flush(self) -> None:
        storage = self._writer.storage
        if storage.chunk.bio.tell():
            storage.close_chunk()
        storage.bio.flush()
