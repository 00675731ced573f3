# SPDX-License-Identifier: Apache-2.0

"""
ROS messages in CDR, the wire format of DDS (OMG DDSI-RTPS, section 10), as arrays.

Messages with the same strings and array lengths have the same layout. They are read, or written,
as one table of bytes, whose offsets the first one shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
import struct

import numpy as np

ORDERS = {b'\x00\x00': '>', b'\x00\x01': '<'}
"""Byte orders of numpy by the identifier of plain CDR (DDSI-RTPS, 10.5)."""

_BODY_OFFSET = 4
"""Size of the encapsulation header, bytes; alignment counts from its end (DDSI-RTPS, 10.2)."""


class CdrError(ValueError):
    """A message that does not match its type."""


@dataclass(frozen=True)
class NumberField:
    """Numbers within a message."""

    offset: int  # Offset of the first one, bytes
    code: str  # Their numpy type without byte order, such as f8
    count: int  # How many there are


class Layout:
    """Offsets of the fields of one message, found from its beginning to its end."""

    def __init__(self, raw: bytes) -> None:
        """Start after the encapsulation header of `raw`."""
        self._raw = raw
        if raw[:2] not in ORDERS:
            raise CdrError(f'encapsulation 0x{raw[:2].hex()} is not plain CDR')
        self.order = ORDERS[raw[:2]]  # Byte order, < or >
        self.fields: dict[str, NumberField] = {}  # The number fields by name
        self.texts: dict[str, str] = {}  # Strings by name, in the order of the message
        # Offsets of the bytes that all messages of this layout share: lengths and strings
        self.fixed: list[int] = [0, 1]
        self._offset = _BODY_OFFSET

    def numbers(self, name: str, code: str, count: int = 1) -> None:
        """Pass over numbers."""
        if count:
            self.fields[name] = NumberField(self._take(int(code[1:]), count), code, count)

    def length(self) -> int:
        """Pass over the length of a string or sequence, and return it."""
        start = self._take(4)
        self.fixed += range(start, start + 4)
        return struct.unpack_from(self.order + 'I', self._raw, start)[0]

    def text(self, name: str) -> None:
        """Pass over a string."""
        size = self.length()
        start = self._take(1, size)
        self.fixed += range(start, start + size)
        self.texts[name] = self._raw[start : start + size].rstrip(b'\0').decode(errors='replace')

    def _take(self, size: int, count: int = 1) -> int:
        """Pass over numbers of a size, and return where they begin: at a multiple of it."""
        start = self._offset + (_BODY_OFFSET - self._offset) % size
        self._offset = start + size * count
        if self._offset > len(self._raw):
            raise CdrError(f'{len(self._raw)} bytes are too few for it')
        return start


def header(raw: bytes) -> Layout:
    """Find the stamp and the frame of a message with a header."""
    layout = Layout(raw)
    layout.numbers('sec', 'i4')
    layout.numbers('nanosec', 'u4')
    layout.text('frame_id')
    return layout


def imu(raw: bytes) -> Layout:
    """Find the fields of a sensor_msgs/Imu."""
    layout = header(raw)
    for name, count in (('orientation', 4), ('angular_velocity', 3), ('linear_acceleration', 3)):
        layout.numbers(name, 'f8', count)
        layout.numbers(f'{name}_covariance', 'f8', 9)
    return layout


def joint_state(raw: bytes) -> Layout:
    """Find the names, positions and velocities of a sensor_msgs/JointState."""
    layout = header(raw)
    for i in range(layout.length()):
        layout.text(f'name{i}')
    for name in ('position', 'velocity'):
        layout.numbers(name, 'f8', layout.length())
    return layout


def _one_field(name: str, code: str, count: int = 1) -> Callable[[bytes], Layout]:
    """Return what finds the field that follows the header."""

    def find(raw: bytes) -> Layout:
        layout = header(raw)
        layout.numbers(name, code, count)
        return layout

    return find


vector3_stamped = _one_field('vector', 'f8', 3)
"""Finds the fields of a geometry_msgs/Vector3Stamped."""

temperature = _one_field('temperature', 'f8')  # Finds the fields of a sensor_msgs/Temperature

battery_state = _one_field('voltage', 'f4')  # Finds the voltage of a sensor_msgs/BatteryState


def message(stamped_frame: str, *parts: str | int | Sequence[float] | np.ndarray) -> bytes:
    """Return a message at the stamp 0 with strings, lengths and numbers behind its header."""
    data = bytearray(b'\0\1\0\0')
    for part in (np.zeros(2, np.int32), stamped_frame, *parts):
        text = part.encode() + b'\0' if isinstance(part, str) else b''
        number = len(text) if isinstance(part, str) else part
        values = np.uint32(number) if isinstance(number, int) else np.asarray(number)
        if values.size:
            data += bytes((_BODY_OFFSET - len(data)) % values.itemsize) + values.tobytes()
        data += text
    return bytes(data)


@dataclass(frozen=True)
class MessageTable:
    """Messages of one layout."""

    rows: np.ndarray  # Their indices among the messages that were given, (n,)
    data: np.ndarray  # Their bytes, (n, size)
    layout: Layout

    def numbers(self, name: str) -> np.ndarray:
        """Return a field of all messages as float64, (n, count)."""
        field = self.layout.fields[name]
        size = int(field.code[1:]) * field.count
        part = np.ascontiguousarray(self.data[:, field.offset : field.offset + size])
        return part.view(self.layout.order + field.code).astype(np.float64)

    @property
    def joints(self) -> list[str]:
        """Return the names of joints."""
        return [text for key, text in self.layout.texts.items() if key != 'frame_id']

    def stamp_ns(self) -> np.ndarray:
        """Return the headers' stamps, ns, (n,) int64."""
        sec = self.numbers('sec')[:, 0].astype(np.int64)
        nanosec = self.numbers('nanosec')[:, 0].astype(np.int64)
        return sec * 1_000_000_000 + nanosec


def tables(
    raws: Sequence[bytes] | np.ndarray, find: Callable[[bytes], Layout]
) -> Iterator[MessageTable]:
    """Group messages by layout; an array has one of equal length in each row."""
    if isinstance(raws, np.ndarray):
        groups = [(np.arange(len(raws)), raws)]
    else:
        sizes = np.array([len(raw) for raw in raws])
        groups = []
        for size in dict.fromkeys(sizes.tolist()):
            rows = np.flatnonzero(sizes == size)
            joined = b''.join([raws[i] for i in rows.tolist()])
            groups.append((rows, np.frombuffer(joined, np.uint8).reshape(len(rows), size)))
    for rows, data in groups:
        while len(rows):
            layout = find(data[0].tobytes())
            differs = (data[:, layout.fixed] != data[0, layout.fixed]).any(axis=1)
            if not differs.any():  # as usual: no copy
                yield MessageTable(rows, data, layout)
                break
            yield MessageTable(rows[~differs], data[~differs], layout)
            rows = rows[differs]
            data = data[differs]


def fill(
    template: bytes,
    find: Callable[[bytes], Layout],
    stamp_ns: np.ndarray,
    fields: Mapping[str, np.ndarray],
) -> np.ndarray:
    """Return the bytes, (n, size), of messages with stamps, ns, (n,), and fields, (n, count)."""
    layout = find(template)
    data = np.tile(np.frombuffer(template, np.uint8), (len(stamp_ns), 1))
    sec, nanosec = np.divmod(stamp_ns, 1_000_000_000)
    for name, values in {'sec': sec, 'nanosec': nanosec, **fields}.items():
        place = layout.fields[name]
        numbers = values.reshape(-1, place.count).astype(layout.order + place.code, 'C')
        data[:, place.offset :][:, : numbers.itemsize * place.count] = numbers.view(np.uint8)
    return data
