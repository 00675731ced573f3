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
Hostile bytes for the decoder and the serial link, two minutes of them.

    make fuzz                       guided by coverage where atheris is installed, else by chance
    make fuzz ARGS='10'             for so many seconds

A part of the inputs is put into frames whose CRC is right, and a part into data frames with
fields as they come: what a liar with a good CRC can say.
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
SENSOR = nominal()
counts = Counter()


class Script:
    """A port that gives chunks, and nothing when they are over; None is a port that was closed."""

    error = ''
    received_bytes = connections = 0
    last_byte_s = opened_s = 0.0

    def __init__(self, chunks):
        self.chunks = chunks

    def read(self):
        return self.chunks.pop(0) if self.chunks else b''

    def confirm(self):
        pass

    def close(self):
        pass


def frames_of(data):
    """Make chunks of an input: raw, in frames, or as the fields of frames."""
    chunks, at = [], 0
    while at + 2 <= len(data) and len(chunks) < 50:
        kind, size = data[at] % 6, data[at + 1]
        part = data[at + 2:at + 2 + size]
        at += 2 + size
        if kind == 0:
            chunks.append(part)
        elif kind == 1:
            chunks.append(wire_format.encode_payload(part))
        elif kind == 2:
            chunks.append(None)
        elif kind == 3:
            fields = part[:12].ljust(12, b'\1')
            rate, bits, channels = struct.unpack('<fBB', fields[:6])
            chunks.append(wire_format.encode_payload(struct.pack(
                '<BBHIfBBf16s', 2, 1, fields[6], 0, rate, bits % 18, channels % 9, 5.0, b'fuzz')))
        else:
            fields = part[:16].ljust(16, b'\2')
            index, time_us, flags, overruns, shape = struct.unpack('<IQBHB', fields)
            if kind == 5:  # near to what goes on
                index, time_us = index % 1000, time_us % 10 ** 6
            count, channels = shape % 16 + 1, shape // 16 % 4 + 1
            codes = (part * 130)[:2 * count * channels].ljust(2 * count * channels, b'\3')
            chunks.append(wire_format.encode_payload(struct.pack(
                '<BBHIQIHBB', 1, 1, flags, 0, time_us, index, overruns, count, channels) + codes))
    return chunks


def one(data):
    """Run the link on an input; whatever it is, samples are sound and in order."""
    link = serial.open_link(SENSOR, SETTINGS)
    chunks = frames_of(data)
    link._port = Script(chunks)
    link._throttle = lambda size, samples: None
    last = -1
    while True:
        done = not chunks and not link._arrivals
        if done:
            link._stamper.flush()
        samples = link.read(0)
        assert np.isfinite(samples.volts).all()
        assert samples.missing >= samples.estimated >= 0
        if len(samples.stamp_ns):
            assert samples.stamp_ns[0] > last
            assert (np.diff(samples.stamp_ns) > 0).all()
            last = samples.stamp_ns[-1]
        counts['samples'] += len(samples.stamp_ns)
        if done:
            break
    assert len(link._splitter._incomplete) <= wire_format.MAX_FRAME_BYTES
    link.status()
    counts['inputs'] += 1


def sound():
    """Make an input that a good board could be: two axes, frames in order, one lost."""
    info = struct.pack('<fBB6x', 1000.0, 16, 2)
    data = bytes([3, len(info)]) + info
    for index in (0, 10, 20, 40, 50, 0, 10):
        fields = struct.pack('<IQBHB', index, 1000 * index, 0, 0, 16 + 9)
        data += bytes([5, len(fields)]) + fields
    return data


def by_chance(seconds, seed):
    """Mutate inputs that worked, without guidance."""
    draw, end = random.Random(seed), time.monotonic() + seconds
    pool = [sound()]
    while time.monotonic() < end:
        data = bytearray(draw.choice(pool))
        for _ in range(draw.randrange(1, 8)):
            at = draw.randrange(len(data) + 1)
            data[at:at + draw.randrange(3)] = draw.randbytes(draw.randrange(4))
        one(bytes(data[:1000]))
        if len(pool) < 500:
            pool.append(bytes(data[:1000]))
    print(f'fuzz: {counts["inputs"]} inputs in {seconds:g} s without atheris, seed {seed}: '
          f'{counts["samples"]} samples, nothing wrong')


def main():
    seconds = int(sys.argv[1]) if len(sys.argv) > 1 else 120
    if atheris is None:
        by_chance(seconds, 1)
        return
    with tempfile.TemporaryDirectory() as corpus:
        Path(corpus, 'sound').write_bytes(sound())
        atheris.Setup([sys.argv[0], f'-max_total_time={seconds}', '-max_len=1000', '-seed=1',
                       '-print_final_stats=1', corpus], one)
        atheris.Fuzz()


if __name__ == '__main__':
    main()
