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
A board on a pseudo-terminal that can be hurt, for the tests of the serial link.

    python faulty_board.py PATH [JSON]

Channel x of sample k is `k % 65534 + 1`, channel y `mark(k)`: each published sample tells which
one it was. Sample k is taken at `origin + k / rate` of the host's monotonic clock; the line
{"origin_ns": ...} on stdout says where that is. Commands come on stdin, one a line, and are
answered by one line when they are done:

    fault KIND RATE     flip, lose, insert or burst, bytes of the stream at a rate; baud: all
    clear               no fault any more
    noise N             so many random bytes; zeros are among them
    flat N              so many bytes without a delimiter
    drop N              samples that the device loses itself and says so
    unplug S            close the terminal, and be there again after so long
    reset S             stop, and begin anew with count and clock at 0 after so long
    halt S              stop, the clock and the count, too; then go on
"""

import json
import os
from pathlib import Path
import pty
import random
import select
import sys
import time
import tty

from adxl_ros.links.support.wire_format import BoardInfo, Encoder
import numpy as np

BLOCK = 10


def mark(k):
    """Return what channel y has at sample k."""
    return (k * 40503 + 12345) % 65534 + 1


class FaultyBoard:
    """The board; `turn` runs it for a few milliseconds."""

    def __init__(self, path, setting):
        self.path = Path(path)
        self.rate = setting.get('rate', 1000.0)
        self.channels = setting.get('channels', 3)
        self.ppm = setting.get('ppm', 0.0)
        self.random = random.Random(setting.get('seed', 1))
        self.fault, self.chance = '', 0.0
        self.ours = self.theirs = None
        self.info = BoardInfo(self.rate, 16, self.channels, 5.0, setting.get('serial', 'T1'))
        self.halted_ns = 0
        self.start_ns = time.monotonic_ns()
        self.k = self.first_k = self.overruns = 0
        self.encoder = Encoder(self.info)
        self.informed_ns = 0
        self.rest = b''
        self.plug()
        if setting.get('banner'):
            self.write(b'\r\nets Jun  8 2016 00:22:57\r\nrst:0x1 (POWERON_RESET)\0\r\nboot\r\n')

    def plug(self):
        self.ours, self.theirs = pty.openpty()
        tty.setraw(self.theirs)
        os.set_blocking(self.ours, False)
        link = self.path.with_suffix('.new')
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self.theirs))
        link.rename(self.path)
        self.rest = b''

    def pull(self):
        self.path.unlink()
        os.close(self.ours)
        os.close(self.theirs)
        self.ours = None

    def time_ns(self, k):
        """Return when sample k is taken, by the host's monotonic clock."""
        return self.start_ns + self.halted_ns + round(k * 1e9 / self.rate * (1 + self.ppm * 1e-6))

    def turn(self):
        now = time.monotonic_ns()
        if now - self.informed_ns > 1e9 and self.write(self.encoder.info_frame()):
            self.informed_ns = now
        while self.time_ns(self.k + BLOCK - 1) <= time.monotonic_ns():
            self.block()
        due = self.time_ns(self.k + BLOCK - 1)
        return max(min((due - time.monotonic_ns()) * 1e-9, 0.02), 0)

    def block(self):
        k = np.arange(self.k, self.k + BLOCK)
        codes = np.full((BLOCK, self.channels), 32768)
        codes[:, 0], codes[:, 1] = k % 65534 + 1, mark(k)
        index = self.k - self.first_k
        raw = self.encoder.sample_frame(round(index * 1e6 / self.rate), index,
                                      codes.astype(np.uint16), self.overruns)
        if not self.write(raw):
            self.overruns += BLOCK
        self.k += BLOCK

    def write(self, raw):
        """Write, hurt as it may be; tell whether there was room."""
        if self.ours is None:
            return False
        try:
            if self.rest:
                self.rest = self.rest[os.write(self.ours, self.rest):]
            if self.rest:
                return False
            hurt = self.hurt(raw)
            self.rest = hurt[os.write(self.ours, hurt):] if hurt else b''
        except BlockingIOError:
            return False
        return True

    def hurt(self, raw):
        draw = self.random
        if self.fault == 'baud':
            return bytes(draw.randrange(256) for _ in raw)
        if not self.fault:
            return raw
        out, left = bytearray(), 0
        for byte in raw:
            if left:
                left -= 1
                out.append(draw.randrange(256))
            elif draw.random() >= self.chance:
                out.append(byte)
            elif self.fault == 'flip':
                out.append(byte ^ 1 << draw.randrange(8))
            elif self.fault == 'insert':
                out += bytes([draw.randrange(256), byte])
            elif self.fault == 'burst':
                left = draw.randrange(5, 60)
        return bytes(out)

    def push(self, raw):
        """Write all of it, however long that takes; nothing else is sent meanwhile."""
        while self.rest:
            self.rest = self.rest[self.some(self.rest):]
        while raw:
            raw = raw[self.some(raw):]

    def some(self, raw):
        select.select([], [self.ours], [], 0.1)
        try:
            return os.write(self.ours, raw[:4096])
        except BlockingIOError:
            return 0

    def obey(self, words):
        name, *rest = words
        number = float(rest[-1]) if rest else 0.0
        if name == 'fault':
            self.fault, self.chance = rest[0], number
        elif name == 'clear':
            self.fault = ''
        elif name == 'noise':
            self.push(self.random.randbytes(int(number)))
        elif name == 'flat':
            self.push(b'\x55' * int(number))
        elif name == 'drop':
            self.k += int(number)
            self.overruns += int(number)
        elif name == 'unplug':
            self.pull()
            time.sleep(number)
            self.skip()
            self.plug()
        elif name == 'reset':
            time.sleep(number)
            self.skip()
            self.first_k, self.overruns = self.k, 0
            self.encoder, self.informed_ns = Encoder(self.info), 0
        elif name == 'halt':
            time.sleep(number)
            self.halted_ns += round(number * 1e9)

    def skip(self):
        """Leave out what could not be sent, block by block as its time is over."""
        while self.time_ns(self.k + BLOCK - 1) <= time.monotonic_ns():
            self.k += BLOCK
            self.overruns += BLOCK


def main():
    setting = json.loads(sys.argv[2]) if len(sys.argv) > 2 else {}
    board = FaultyBoard(sys.argv[1], setting)
    print(json.dumps({'origin_ns': board.start_ns}), flush=True)
    wait = 0.0
    while True:
        if select.select([sys.stdin], [], [], wait)[0]:
            line = sys.stdin.readline()
            if not line:
                return
            board.obey(line.split())
            print(json.dumps({'at_ns': time.monotonic_ns(), 'k': board.k,
                              'halted_ns': board.halted_ns}), flush=True)
        wait = board.turn()


if __name__ == '__main__':
    main()
