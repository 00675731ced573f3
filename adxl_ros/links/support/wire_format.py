# SPDX-License-Identifier: Apache-2.0

"""
The serial wire format, version 1: frames of samples, encoded and decoded.

A frame is COBS(payload, CRC-32 of the payload) and one 0x00; all numbers are little-endian. The
format is the contract with the board: docs/reference/wire_format.md has its table, firmware/ its
encoder in C.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import itertools
import struct
import zlib

import numpy as np

VERSION = 1  # Version of the format
SAMPLES_TYPE = 1  # Type of a frame with samples
INFO_TYPE = 2  # Type of a frame that describes the board
LATENCY_TYPE = 3
"""Type of a command, a frame from the host to the board: how many samples a frame has."""
SELF_TEST_TYPE = 4  # Type of a command: for how long the self-test of the sensor is on
RAIL = 1  # Flag of a frame with samples: a code is at a rail of the ADC
AFTER_RESET = 2  # Flag of all frames from a reset to the first one with samples
IN_SELF_TEST = 4
"""Flag of a frame with samples: the self-test moves the sensor, or has moved it just before."""
HAS_SELF_TEST = 8  # Flag of an info frame: the board switches the self-test of its sensor
MAX_CHANNELS = 8  # Most channels of a board; a frame with more of them is invalid

_SAMPLES = struct.Struct('<BBHIQIHBB')
"""A payload with samples: type, version, flags, block_seq, time, index, overruns, numbers of
samples and channels."""
_INFO = struct.Struct('<BBHIfBBf16s')
"""An info payload: the same four, then sample rate, bits, channels, vref, serial number."""
_COMMAND = struct.Struct('<BBHII')
"""A command, the shortest payload: the same four, then a time in µs."""
_CRC = struct.Struct('<I')  # CRC-32 behind the payload, as zlib computes it
MAX_COUNT = 255  # Most samples of a frame: their number is a u8
_BLOCK = 254  # Most bytes of a block of COBS
_MAX_PAYLOAD = _SAMPLES.size + MAX_COUNT * MAX_CHANNELS * 2  # Most bytes of a payload
MAX_FRAME_BYTES = _MAX_PAYLOAD + _CRC.size + 2 + _MAX_PAYLOAD // 254
"""Most bytes of a frame without its 0x00: COBS adds one byte for each 254."""
_MAX_LOAD = 0.85
"""Largest share of the time of a wire that frames take. Chosen: info frames and the tolerance of
baud rates, 5 %, need the other part."""
_MAX_TIME_US = 2**53  # Largest time of a device clock, µs: 285 years
RATES_HZ = (0.01, 1e5)  # Bounds of the sample rate, Hz, as `sensor.rate_hz` permits
_VREFS_V = (0.1, 100.0)  # Bounds of the reference voltage, V, as `sensor.adc_vref_v` permits
MAX_BITS = 16  # Largest resolution of the ADC, bit: codes are u16
MAX_SERIAL = 16  # Most characters of a serial number
_TOLERANCE_US = 1000.0  # Absolute tolerance between the device's clock and its count, µs
_TOLERANCE = 0.002
"""Relative tolerance between the device's clock and its count. Chosen: a real rate differs from
the stated one by less."""
_AWAY_TOLERANCE_US = 250e3
"""Tolerance between the clocks of device and host while a port was closed, µs."""


class WireError(Exception):
    """Bytes that are no frame of this format."""


@dataclass(frozen=True)
class BoardInfo:
    """How a board describes itself."""

    rate_hz: float  # Sample rate, Hz
    bits: int  # Resolution of the ADC, bit
    channels: int  # Number of channels
    vref_v: float  # Reference voltage of the ADC, V
    serial: str  # Serial number of the sensor; '' without one
    # `AFTER_RESET`, `HAS_SELF_TEST`; two descriptions are equal whatever their flags
    flags: int = field(default=0, compare=False)


@dataclass(frozen=True)
class SampleFrame:
    """Samples at equal steps of the device clock."""

    flags: int  # `RAIL`, `AFTER_RESET`, `IN_SELF_TEST`
    sequence: int  # Number of the frame, wraps at 2^32
    time_us: int  # Device clock at the first sample, µs
    index: int  # Number of the first sample, dropped samples included, wraps at 2^32
    overruns: int  # Samples that the device itself has dropped since its reset, wraps at 2^16
    codes: np.ndarray  # ADC codes, (n, m) uint16


class Encoder:
    """Encodes and numbers frames, as the firmware does."""

    def __init__(self, info: BoardInfo) -> None:
        self.info = info
        self._sequence = itertools.count()
        self._flags = AFTER_RESET

    def info_frame(self) -> bytes:
        """Encode the frame that comes first and then every second."""
        i = self.info
        return encode_payload(
            _INFO.pack(
                INFO_TYPE,
                VERSION,
                i.flags | self._flags,
                next(self._sequence) % 2**32,
                i.rate_hz,
                i.bits,
                i.channels,
                i.vref_v,
                i.serial.encode('ascii'),
            )
        )

    def sample_frame(
        self, time_us: int, index: int, codes: np.ndarray, overruns: int = 0, flags: int = 0
    ) -> bytes:
        """Encode ADC codes, (n, m), n and m at most 255, as a frame of samples."""
        rail = RAIL if (codes == 0).any() or (codes >= 2**self.info.bits - 1).any() else 0
        flags |= self._flags | rail
        self._flags = 0
        head = _SAMPLES.pack(
            SAMPLES_TYPE,
            VERSION,
            flags,
            next(self._sequence) % 2**32,
            time_us,
            index % 2**32,
            overruns % 2**16,
            *codes.shape,
        )
        return encode_payload(head + codes.astype('<u2').tobytes())


def encode_payload(payload: bytes) -> bytes:
    """Append the CRC to a payload, encode both by COBS and append 0x00."""
    return _stuff(payload + _CRC.pack(zlib.crc32(payload))) + b'\0'


def decode(raw: bytes) -> BoardInfo | SampleFrame:
    """Decode one frame."""
    payload = _checked_payload(raw)
    if payload[0] == INFO_TYPE:
        return _decode_info(payload)
    if payload[0] == SAMPLES_TYPE:
        return _decode_samples(payload)
    raise WireError(f'unknown type {payload[0]}')


@dataclass(frozen=True)
class Command:
    """What the host asks of a board."""

    kind: int  # `LATENCY_TYPE`, `SELF_TEST_TYPE`, or one that this version does not know
    # Longest time for which the samples of a frame are collected, or time for which the self-test
    # is on from now, µs; 0 ends it
    time_us: int


def encode_command(sequence: int, time_us: int, kind: int = LATENCY_TYPE) -> bytes:
    """Encode the frame of a command."""
    payload = _COMMAND.pack(kind, VERSION, 0, sequence % 2**32, min(time_us, 2**32 - 1))
    return b'\0' + encode_payload(payload)


def decode_command(raw: bytes) -> Command:
    """Decode the frame of a command."""
    payload = _checked_payload(raw)
    if len(payload) != _COMMAND.size:
        raise WireError('no command')
    return Command(payload[0], _COMMAND.unpack(payload)[-1])


def samples_that_fit(count: int, info: BoardInfo, bytes_per_s: float) -> int:
    """Return the smallest number of samples of a frame that a wire carries with a margin."""
    for samples in range(count, MAX_COUNT):
        payload = _SAMPLES.size + 2 * samples * info.channels + _CRC.size
        frame_bytes = payload + 2 + payload // _BLOCK
        if frame_bytes * info.rate_hz / samples <= _MAX_LOAD * bytes_per_s:
            return samples
    return MAX_COUNT


def _stuff(raw: bytes) -> bytes:
    """
    Encode by consistent overhead byte stuffing (Cheshire and Baker 1999), without 0x00.

    A block is its length plus 1 and up to 254 bytes. A shorter one stands for its bytes and 0x00.
    """
    stuffed = bytearray()
    for run in raw.split(b'\0'):
        blocks = [run[i : i + _BLOCK] for i in range(0, len(run) + 1, _BLOCK)]
        for block in blocks:
            stuffed.append(len(block) + 1)
            stuffed += block
    if len(blocks) > 1 and not blocks[-1]:
        del stuffed[-1]  # nothing follows the last full block
    return bytes(stuffed)


def unstuff(raw: bytes) -> bytes:
    """Return the bytes of a frame as they were before `_stuff`."""
    if 0 in raw:
        raise WireError('zero byte found in input')
    parts = []
    at = 0
    while at < len(raw):
        length = raw[at]
        parts.append(raw[at + 1 : at + length])
        at += length
        if length <= _BLOCK and at < len(raw):
            parts.append(b'\0')
    if at > len(raw):
        raise WireError('not enough input bytes for length code')
    return b''.join(parts)


def _checked_payload(raw: bytes) -> bytes:
    """Return the payload of a frame; raise `WireError` unless whole and of this version."""
    decoded = unstuff(raw)
    payload, check = decoded[: -_CRC.size], decoded[-_CRC.size :]
    if len(payload) < _COMMAND.size or check != _CRC.pack(zlib.crc32(payload)):
        raise WireError('the CRC does not match')
    if payload[1] != VERSION:
        raise WireError(f'wire format {payload[1]}')
    return payload


def _decode_info(payload: bytes) -> BoardInfo:
    if len(payload) != _INFO.size:
        raise WireError('no info frame')
    _, _, flags, _, rate_hz, bits, channels, vref_v, serial = _INFO.unpack(payload)
    name = serial.rstrip(b'\0')
    is_within = (
        RATES_HZ[0] <= rate_hz <= RATES_HZ[1]
        and _VREFS_V[0] <= vref_v <= _VREFS_V[1]
        and 1 <= bits <= MAX_BITS
        and 1 <= channels <= MAX_CHANNELS
    )
    is_printable = all(32 <= byte < 127 for byte in name)
    if not (is_within and is_printable):
        raise WireError('an info frame beyond the bounds of the format')
    return BoardInfo(
        rate_hz=rate_hz,
        bits=bits,
        channels=channels,
        vref_v=vref_v,
        serial=name.decode('ascii').strip(),
        flags=flags,
    )


def _decode_samples(payload: bytes) -> SampleFrame:
    if len(payload) < _SAMPLES.size:
        raise WireError('no frame of samples')
    (_, _, flags, sequence, time_us, index, overruns, count, channels) = _SAMPLES.unpack_from(
        payload
    )
    is_whole = len(payload) == _SAMPLES.size + 2 * count * channels
    is_within = count and 0 < channels <= MAX_CHANNELS and time_us <= _MAX_TIME_US
    if not (is_whole and is_within):
        raise WireError('a frame of samples beyond the bounds of the format')
    codes = np.frombuffer(payload, '<u2', offset=_SAMPLES.size).reshape(count, channels)
    return SampleFrame(
        flags=flags,
        sequence=sequence,
        time_us=time_us,
        index=index,
        overruns=overruns,
        codes=codes,
    )


class Splitter:
    """Splits a stream of bytes at each 0x00 and holds at most one frame."""

    def __init__(self) -> None:
        self.skipped = 0  # Bytes of runs that are too long for a frame
        self._incomplete = b''
        self._skipping = False

    def split(self, chunk: bytes) -> list[bytes]:
        """Return the runs that end within this chunk, without the empty ones."""
        *ended, rest = chunk.split(b'\0')
        frames = []
        for part in ended:
            raw = self._incomplete + part
            self._incomplete = b''
            if self._skipping or len(raw) > MAX_FRAME_BYTES:
                self.skipped += len(raw)
                self._skipping = False
            elif raw:
                frames.append(raw)
        self._incomplete += rest
        if self._skipping or len(self._incomplete) > MAX_FRAME_BYTES:
            self.skipped += len(self._incomplete)
            self._incomplete = b''
            self._skipping = True
        return frames

    def restart(self) -> None:
        """Drop the incomplete frame: the next byte does not belong to it."""
        self._incomplete = b''
        self._skipping = False


@dataclass(frozen=True)
class AcceptedFrame:
    """A frame whose samples are published."""

    frame: SampleFrame
    # Number of samples that are missing before it, exactly; None where a new count begins
    lost: int | None
    stepped: bool = False  # Whether the device's clock has stepped since the previous frame


class FrameCounter:
    """
    Decides for each frame: the next one, one after a gap, a repeated one, or a new count.

    repeated: samples of frames that came twice or late; overruns: samples that the device itself
    dropped.
    """

    def __init__(self) -> None:
        self.repeated = self.overruns = 0
        self._period_us = 0.0
        self._first: SampleFrame | None = None  # First frame of the count
        self._previous: SampleFrame | None = None
        self._arrived_us = 0.0
        self._closed_us: float | None = None
        # A frame of another count, until the next frame tells whether it is late or after a reset
        self._pending: SampleFrame | None = None

    def restart(self, rate_hz: float) -> None:
        """Let the next frame begin a new count, at a sample rate, Hz."""
        self._period_us = 1e6 / rate_hz
        self._previous = self._pending = None

    def reopened(self) -> None:
        """Take note that the next frames may come from another device."""
        if self._closed_us is None:
            self._closed_us = self._arrived_us
        self._pending = None

    def accept(self, frame: SampleFrame, arrived_ns: int) -> list[AcceptedFrame]:
        """Take the next frame of the stream; return the frames whose samples are published."""
        arrived_us = arrived_ns * 1e-3
        pending = self._pending
        self._pending = None
        following = self._follow(frame, arrived_us)
        accepted = [] if following is None else [following]
        if pending is not None:
            ahead, passed_us = self._step(pending, frame)
            if following is None and ahead >= 0 and self._agree(ahead, passed_us):
                # Two frames in a row have another count: the device was reset without a message.
                accepted = [AcceptedFrame(pending, None), AcceptedFrame(frame, ahead)]
            else:
                self.repeated += len(pending.codes)
        if not accepted:
            self._pending = frame
        for part in accepted:
            if part.lost is None:
                self._first = part.frame
            elif self._previous is not None:
                self.overruns += (part.frame.overruns - self._previous.overruns) % 2**16
            self._previous = part.frame
            self._closed_us = None
            self._arrived_us = arrived_us
        return accepted

    def _follow(self, frame: SampleFrame, arrived_us: float) -> AcceptedFrame | None:
        """Compare a frame with the previous one; None where the next one must decide."""
        # The first frames of a count have the flag of a reset, also where they come twice.
        is_first = self._first is not None and (frame.sequence, frame.time_us, frame.index) == (
            self._first.sequence,
            self._first.time_us,
            self._first.index,
        )
        if self._previous is None or (frame.flags & AFTER_RESET and not is_first):
            return AcceptedFrame(frame, None)
        ahead, passed_us = self._step(self._previous, frame)
        in_step = self._agree(ahead, passed_us)
        if ahead == 0:
            return AcceptedFrame(frame, 0, not in_step)
        if self._closed_us is not None:
            away_us = arrived_us - self._closed_us
            in_step &= abs(away_us - passed_us) < _AWAY_TOLERANCE_US + _TOLERANCE * away_us
        elif ahead < 0:
            return None
        return AcceptedFrame(frame, ahead if ahead > 0 and in_step else None)

    def _step(self, first: SampleFrame, second: SampleFrame) -> tuple[int, float]:
        """Return the samples and the time, µs, from the end of a frame to another one."""
        count = len(first.codes)
        # The numbers of samples wrap at 2^32.
        ahead = (second.index - first.index - count + 2**31) % 2**32 - 2**31
        return ahead, second.time_us - first.time_us - count * self._period_us

    def _agree(self, samples: int, passed_us: float) -> bool:
        """Return whether a number of samples fits a time by the device's clock, µs."""
        tolerance_us = _TOLERANCE_US + 0.5 * self._period_us + _TOLERANCE * abs(passed_us)
        return abs(passed_us - samples * self._period_us) < tolerance_us
