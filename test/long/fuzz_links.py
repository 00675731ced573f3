# SPDX-License-Identifier: Apache-2.0

"""
Arbitrary bytes for the decoder and the serial link, for two minutes.

    make fuzz                       guided by coverage where atheris is installed, else random
    make fuzz ARGS='10'             for 10 s

Some inputs are put into frames with a right CRC. Others are the fields of frames with samples,
which a faulty board with a right CRC can send.
"""

from collections import Counter
from pathlib import Path
import random
import struct
import sys
import tempfile
import time

try:
    import atheris
except ImportError:
    atheris = None

if atheris:
    with atheris.instrument_imports(include=['adxl_ros.links']):
        from adxl_ros.links import serial
        from adxl_ros.links.support import wire_format
else:
    from adxl_ros.links import serial
    from adxl_ros.links.support import wire_format
import numpy as np
from units import nominal

SETTINGS = serial.Settings(port='/dev/null')
"""Settings of the link; its port is replaced."""
SENSOR = nominal()
"""Sensor of the link."""
MAX_INPUT = 1000
"""Largest number of bytes of an input."""
MAX_CHUNKS = 50
"""Largest number of chunks of an input."""
MAX_POOL = 500
"""Largest number of inputs that are kept for mutation."""
counts = Counter()


class ScriptedPort:
    """A port that delivers chunks, then no bytes; None stands for a port that was closed."""

    error = ''
    received_bytes = connections = 0
    last_byte_s = opened_s = 0.0
    uart_bytes_per_s = 960.0

    def __init__(self, chunks):
        self.chunks = chunks

    def read(self):
        """Return the next chunk."""
        return self.chunks.pop(0) if self.chunks else b''

    def write(self, raw):
        """Check that the host writes a command and nothing else."""
        wire_format.decode_command(raw[1:-1])

    def confirm(self):
        """Do nothing: this port never fails."""

    def close(self):
        """Do nothing."""


def chunks_of(data):
    """Make chunks of an input: bytes as they are, frames, or frames of the fields."""
    chunks, begin = [], 0
    while begin + 2 <= len(data) and len(chunks) < MAX_CHUNKS:
        kind, size = data[begin] % 6, data[begin + 1]
        part = data[begin + 2:begin + 2 + size]
        begin += 2 + size
        if kind == 0:
            chunks.append(part)
        elif kind == 1:
            chunks.append(wire_format.encode_payload(part))
        elif kind == 2:
            chunks.append(None)
        elif kind == 3:
            chunks.append(info_frame(part))
        else:
            chunks.append(sample_frame(part, plausible=kind == 5))
    return chunks


def info_frame(part):
    """Make an info frame whose fields come from bytes."""
    fields = part[:12].ljust(12, b'\1')
    rate, bits, channels = struct.unpack('<fBB', fields[:6])
    return wire_format.encode_payload(struct.pack(
        '<BBHIfBBf16s', 2, 1, fields[6], 0, rate, bits % 18, channels % 9, 5.0, b'fuzz'))


def sample_frame(part, plausible):
    """Make a frame of samples whose fields come from bytes; a plausible one is near a count."""
    fields = part[:16].ljust(16, b'\2')
    index, time_us, flags, overruns, shape = struct.unpack('<IQBHB', fields)
    if plausible:
        index, time_us = index % 1000, time_us % 10 ** 6
    count, channels = shape % 16 + 1, shape // 16 % 4 + 1
    codes = (part * 130)[:2 * count * channels].ljust(2 * count * channels, b'\3')
    return wire_format.encode_payload(struct.pack(
        '<BBHIQIHBB', 1, 1, flags, 0, time_us, index, overruns, count, channels) + codes)


def run_input(data):
    """Run the link on an input, and check that its samples are finite and in order."""
    link = serial.open_link(SENSOR, SETTINGS)
    chunks = chunks_of(data)
    link._port = ScriptedPort(chunks)
    link._throttle = lambda size, samples: None
    last_ns = -1
    complete = False
    while not complete:
        complete = not chunks and not link._arrivals
        if complete:
            link._stamper.flush()
        samples = link.read(0)
        assert np.isfinite(samples.volts).all()
        assert samples.missing >= samples.estimated >= 0
        if len(samples.stamp_ns):
            assert samples.stamp_ns[0] > last_ns
            assert (np.diff(samples.stamp_ns) > 0).all()
            last_ns = samples.stamp_ns[-1]
        counts['samples'] += len(samples.stamp_ns)
    assert len(link._splitter._incomplete) <= wire_format.MAX_FRAME_BYTES
    link.status()
    counts['inputs'] += 1


def valid_input():
    """Make an input that a board could send: two axes, frames in order, one of them lost."""
    info = struct.pack('<fBB6x', 1000.0, 16, 2)
    data = bytes([3, len(info)]) + info
    for index in (0, 10, 20, 40, 50, 0, 10):
        fields = struct.pack('<IQBHB', index, 1000 * index, 0, 0, 16 + 9)
        data += bytes([5, len(fields)]) + fields
    return data


def run_random(duration_s, seed):
    """Run random mutations of earlier inputs, without guidance by coverage."""
    draw, end_s = random.Random(seed), time.monotonic() + duration_s
    pool = [valid_input()]
    while time.monotonic() < end_s:
        data = bytearray(draw.choice(pool))
        for _ in range(draw.randrange(1, 8)):
            k = draw.randrange(len(data) + 1)
            data[k:k + draw.randrange(3)] = draw.randbytes(draw.randrange(4))
        run_input(bytes(data[:MAX_INPUT]))
        if len(pool) < MAX_POOL:
            pool.append(bytes(data[:MAX_INPUT]))
    print(f'fuzz: {counts["inputs"]} inputs in {duration_s:g} s without atheris, seed {seed}: '
          f'{counts["samples"]} samples, no failure')


def main():
    """Run inputs for a time."""
    duration_s = int(sys.argv[1]) if len(sys.argv) > 1 else 120
    if atheris is None:
        run_random(duration_s, 1)
        return
    with tempfile.TemporaryDirectory() as corpus:
        Path(corpus, 'valid').write_bytes(valid_input())
        atheris.Setup([sys.argv[0], f'-max_total_time={duration_s}', f'-max_len={MAX_INPUT}',
                       '-seed=1', '-print_final_stats=1', corpus], run_input)
        atheris.Fuzz()


if __name__ == '__main__':
    main()
