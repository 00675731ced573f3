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

"""
The serial wire format, version 1: frames of samples, encoded and decoded.

A frame is COBS(payload, CRC-32 of the payload) and one 0x00; everything is little-endian. The
format is the contract with the board: docs/links.md has its table, firmware/ its encoder in C.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite
import struct
from typing import Any
import zlib

from adxl_ros.errors import UserError
import numpy as np

VERSION = 1
DATA, INFO = 1, 2
RAIL, AFTER_RESET = 1, 2
"""Flags of a data frame."""
MOST_CHANNELS = 8
"""A board has at most so many: what says more is no frame of ours."""

_COMMON = struct.Struct('<BBHI')
_DATA = struct.Struct('<BBHIQIHBB')
_INFO = struct.Struct('<BBHIfBBf16s')
_CRC = struct.Struct('<I')
_LONGEST_PAYLOAD = _DATA.size + 255 * MOST_CHANNELS * 2
MOST_BYTES = _LONGEST_PAYLOAD + _CRC.size + 2 + _LONGEST_PAYLOAD // 254
"""Of a frame, its 0x00 left out; a longer run without 0x00 is skipped."""
_LAST_US = 2 ** 53
"""A device clock beyond 285 years is none."""


class WireError(Exception):
    """Bytes that are no frame of this format."""


class VersionError(WireError):
    """A whole frame of another version."""


@dataclass(frozen=True)
class Info:
    """
    What a board says of itself: the sample rate, Hz, its ADC, V, and its serial number.

    The flags do not count when two are compared.
    """

    rate_hz: float
    bits: int
    channels: int
    vref_v: float
    serial: str
    flags: int = field(default=0, compare=False)


@dataclass(frozen=True)
class Data:
    """
    Samples at equal steps of the device clock.

    Attributes
    ----------
    flags
        `RAIL`, `AFTER_RESET`.
    sequence
        Number of the frame, wraps at 2^32.
    time_us
        Device clock of the first sample, µs.
    index
        Number of the first sample among all that the device should have taken, wraps at 2^32.
    overruns
        Samples that the device itself dropped since its reset, wraps at 2^16.
    codes
        ADC codes, (n, m) uint16.
    check
        CRC-32 of the payload, which tells frames from each other.

    """

    flags: int
    sequence: int
    time_us: int
    index: int
    overruns: int
    codes: np.ndarray
    check: int = 0


class Encoder:
    """
    The board's side: makes frames and counts them.

    Tests and `simulate --port` are boards by it.
    """

    def __init__(self, info: Info) -> None:
        """Begin as after a reset."""
        self.info = info
        self._sequence = 0
        self._flags = AFTER_RESET

    def info_frame(self) -> bytes:
        """Make the frame that comes first and then every second."""
        i = self.info
        return frame(_INFO.pack(INFO, VERSION, self._flags, self._next(), i.rate_hz, i.bits,
                                i.channels, i.vref_v, i.serial.encode('ascii')))

    def data_frame(self, time_us: int, index: int, codes: np.ndarray, overruns: int = 0,
                   flags: int = 0) -> bytes:
        """
        Make a frame of samples.

        Parameters
        ----------
        time_us, index
            Of the first sample.
        codes
            ADC codes, (n, m), n and m at most 255.
        overruns
            Samples dropped so far.
        flags
            Beside those that are set here: that of the first frames after a reset, up to the
            first with samples, and that of a sample at its rail.

        """
        rail = RAIL if (codes == 0).any() or (codes >= 2 ** self.info.bits - 1).any() else 0
        flags |= self._flags | rail
        self._flags = 0
        head = _DATA.pack(DATA, VERSION, flags, self._next(), time_us, index % 2 ** 32,
                          overruns % 2 ** 16, *codes.shape)
        return frame(head + codes.astype('<u2').tobytes())

    def _next(self) -> int:
        self._sequence += 1
        return (self._sequence - 1) % 2 ** 32


def frame(payload: bytes) -> bytes:
    """Put the CRC behind a payload, and both into COBS with its 0x00."""
    return library().encode(payload + _CRC.pack(zlib.crc32(payload))) + b'\0'


def decode(raw: bytes) -> Info | Data:
    """
    Read one frame.

    Parameters
    ----------
    raw
        The bytes between two 0x00.

    Raises
    ------
    VersionError
        It is whole, but of another version.
    WireError
        It is damaged, or says what cannot be.

    """
    cobs = library()
    try:
        whole = cobs.decode(raw)
    except cobs.DecodeError as error:
        raise WireError(str(error)) from None
    payload, check = whole[:-_CRC.size], whole[-_CRC.size:]
    if len(payload) < _COMMON.size or check != _CRC.pack(zlib.crc32(payload)):
        raise WireError('the CRC does not match')
    kind, version = payload[:2]
    if version != VERSION:
        raise VersionError(f'wire format {version}')
    if kind == INFO:
        return _info(payload)
    if kind == DATA:
        return _data(payload, *_CRC.unpack(check))
    raise WireError(f'unknown type {kind}')


def _info(payload: bytes) -> Info:
    if len(payload) != _INFO.size:
        raise WireError(f'an info frame of {len(payload)} bytes')
    _, _, flags, _, rate_hz, bits, channels, vref_v, serial = _INFO.unpack(payload)
    name = serial.rstrip(b'\0')
    if not (isfinite(rate_hz) and 0.01 <= rate_hz <= 1e5 and 1 <= bits <= 16
            and 1 <= channels <= MOST_CHANNELS and isfinite(vref_v) and 0.1 <= vref_v <= 100
            and all(32 <= byte < 127 for byte in name)):
        raise WireError(f'an info frame with {rate_hz:g} Hz, {bits} bits, {channels} channels, '
                        f'{vref_v:g} V, {name!r}')
    return Info(rate_hz, bits, channels, vref_v, name.decode('ascii').strip(),
                flags)


def _data(payload: bytes, check: int) -> Data:
    if len(payload) < _DATA.size:
        raise WireError(f'a data frame of {len(payload)} bytes')
    _, _, flags, sequence, time_us, index, overruns, count, channels = _DATA.unpack_from(payload)
    if (len(payload) != _DATA.size + 2 * count * channels or not count
            or not 0 < channels <= MOST_CHANNELS or time_us > _LAST_US):
        raise WireError(f'a data frame of {count} samples of {channels} channels in '
                        f'{len(payload)} bytes at {time_us} us')
    codes = np.frombuffer(payload, '<u2', offset=_DATA.size).reshape(count, channels)
    return Data(flags, sequence, time_us, index, overruns, codes, check)


class Splitter:
    """
    Cuts a stream of bytes at each 0x00; holds no more than one frame, whatever comes.

    Attributes
    ----------
    skipped
        Bytes of runs too long to be a frame.

    """

    def __init__(self) -> None:
        """Begin anywhere in the stream."""
        self.skipped = 0
        self._rest = b''
        self._skipping = False

    def __call__(self, chunk: bytes) -> list[bytes]:
        """Return what has ended with this chunk, empty runs left out."""
        *whole, rest = chunk.split(b'\0')
        ended = []
        for part in whole:
            raw, self._rest = self._rest + part, b''
            if self._skipping or len(raw) > MOST_BYTES:
                self.skipped += len(raw)
                self._skipping = False
            elif raw:
                ended.append(raw)
        self._rest += rest
        if self._skipping or len(self._rest) > MOST_BYTES:
            self.skipped += len(self._rest)
            self._rest, self._skipping = b'', True
        return ended

    def restart(self) -> None:
        """Forget what has begun: the next byte does not belong to it."""
        self._rest, self._skipping = b'', False


def library() -> Any:
    """Return the module cobs.cobs; raises `UserError` where it is not installed."""
    try:
        from cobs import cobs
    except ImportError:
        raise UserError('the serial wire format needs the Python package cobs: '
                        'pip install pyserial cobs') from None
    return cobs
