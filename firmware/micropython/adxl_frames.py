# SPDX-License-Identifier: Apache-2.0

"""Frames of the serial wire format of adxl_ros, version 1: docs/reference/wire_format.md."""

import binascii
import struct

VERSION = 1
SAMPLES, INFO, LATENCY, SELF_TEST = 1, 2, 3, 4  # Types of frames; the last two are commands
RAIL = 1  # Flag: a code is at a rail of the ADC
AFTER_RESET = 2  # Flag of all frames from a reset to the first one with samples
IN_SELF_TEST = 4  # Flag: a self-test has changed the samples
HAS_SELF_TEST = 8  # Flag of a description: the board switches the self-test of its sensor
STOP = b'\r\x03'  # What mpremote sends to stop a program; no command begins so
_LONGEST = 64  # Bytes that are kept of the host; a command has 17


def stuff(raw):
    """Encode by COBS, without the last 0x00."""
    out = bytearray()
    for run in raw.split(b'\0'):
        while len(run) >= 254:
            out.append(255)
            out.extend(run[:254])
            run = run[254:]
        out.append(len(run) + 1)
        out.extend(run)
    return bytes(out)


def unstuff(raw):
    """Decode COBS; return b'' for bytes that are not valid."""
    out, at = bytearray(), 0
    while at < len(raw):
        length = raw[at]
        if at + length > len(raw):
            return b''
        out.extend(raw[at + 1 : at + length])
        at += length
        if length < 255 and at < len(raw):
            out.append(0)
    return bytes(out)


def frame(payload):
    """Return the frame of a payload."""
    return stuff(payload + struct.pack('<I', binascii.crc32(payload))) + b'\0'


class Encoder:
    """Numbers and encodes the frames of a board."""

    def __init__(self, serial_number, bits, vref_v, channels, info_flags):
        self._serial = serial_number.encode()
        self._bits, self._vref_v, self._channels = bits, vref_v, channels
        self._sequence, self._flags = 0, AFTER_RESET
        self._info_flags = info_flags

    def info(self, rate_hz):
        """Return the frame that describes the board."""
        fields = self._bits, self._channels, self._vref_v, self._serial
        head = self._head(INFO, self._flags | self._info_flags)
        return frame(head + struct.pack('<fBBf16s', rate_hz, *fields))

    def samples(self, time_us, index, overruns, codes, flags):
        """Return the frame of some samples, which is a list of lists of codes."""
        flat = [code for sample in codes for code in sample]
        if min(flat) == 0 or max(flat) >= (1 << self._bits) - 1:
            flags |= RAIL
        payload = self._head(SAMPLES, self._flags | flags)
        self._flags = 0
        counts = index & 0xFFFFFFFF, overruns & 0xFFFF, len(codes), self._channels
        payload += struct.pack('<QIHBB', time_us, *counts)
        return frame(payload + struct.pack(f'<{len(flat)}H', *flat))

    def _head(self, kind, flags):
        head = struct.pack('<BBHI', kind, VERSION, flags, self._sequence)
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        return head


class Receiver:
    """Finds the commands in the bytes of the host."""

    def __init__(self):
        self._run = bytearray()  # Bytes since the last 0x00

    def take(self, byte):
        """Take one byte; return the payload of the command that it completes, or None."""
        if byte:
            if len(self._run) < _LONGEST:
                self._run.append(byte)
            if self._run == STOP:
                raise KeyboardInterrupt
            return None
        payload, self._run = unstuff(bytes(self._run)), bytearray()
        body, check = payload[:-4], payload[-4:]
        if len(body) < 8 or body[1] != VERSION or check != struct.pack('<I', binascii.crc32(body)):
            return None
        return body
