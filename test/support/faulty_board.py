# SPDX-License-Identifier: Apache-2.0

"""
A board with faults on a pseudo-terminal, for the tests of the serial link.

    python faulty_board.py PATH [JSON]

Channel x of sample k is `k % CODES + 1`, channel y is `mark(k)`. So each published sample has its
number. The board takes sample k at `origin + k / rate` of the host's monotonic clock. Its first
line on stdout is {"origin_ns": ...}. Each line on stdin is a command, and a line of JSON answers
when it is done:

    fault KIND RATE     flip, lose, insert or burst bytes of the stream at a rate; baud: all bytes
    clear               end the fault
    noise N             send N random bytes, zeros among them
    flat N              send N bytes without a delimiter
    drop N              lose N samples on the device and count them
    unplug S            close the terminal and open it again after S seconds
    reset S             stop, and begin with count and clock at 0 after S seconds
    halt S              stop for S seconds with clock and count, then continue

It obeys the commands of the host. With "keeps": true in its options it keeps what does not fit in
the terminal, however long the driver is held up; else it loses that.
"""

from contextlib import suppress
import json
import os
from pathlib import Path
import pty
import random
import select
import sys
import time
import tty

from adxl_ros.links.support import wire_format
from adxl_ros.links.support.base import samples_within
from adxl_ros.links.support.wire_format import BoardInfo, Encoder, Splitter, WireError
import numpy as np

CODES = 65534
"""Number of codes between the rails of a 16 bit ADC."""
BLOCK = 10
"""Most samples of a frame, and those before the first command, as the firmware sends them."""
BANNER = b'\r\nets Jun  8 2016 00:22:57\r\nrst:0x1 (POWERON_RESET)\0\r\nboot\r\n'
"""What an ESP32 prints when it starts."""


def mark(k):
    """Return the code of channel y at sample k."""
    return (k * 40503 + 12345) % CODES + 1


class FaultyBoard:
    """The board; `turn` runs it for a few milliseconds."""

    def __init__(self, path, options):
        self.path = Path(path)
        self.rate = options.get('rate', 1000.0)
        self.channels = options.get('channels', 3)
        self.ppm = options.get('ppm', 0.0)
        self.random = random.Random(options.get('seed', 1))
        self.fault, self.fault_rate = '', 0.0
        self.board_fd = self.driver_fd = None
        self.info = BoardInfo(self.rate, 16, self.channels, 5.0, options.get('serial', 'T1'))
        self.halted_ns = 0
        self.origin_ns = time.monotonic_ns()
        self.next_sample = self.first_sample = self.overruns = 0
        self.encoder = Encoder(self.info)
        self.informed_ns = 0
        self.unsent = b''
        self.block = BLOCK
        self.keeps = options.get('keeps', False)
        self.received = Splitter()
        self.plug()
        if options.get('banner'):
            self.write(BANNER)

    def plug(self):
        self.board_fd, self.driver_fd = pty.openpty()
        tty.setraw(self.driver_fd)
        os.set_blocking(self.board_fd, False)
        link = self.path.with_suffix('.new')
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self.driver_fd))
        link.rename(self.path)
        self.unsent = b''

    def unplug(self):
        self.path.unlink()
        os.close(self.board_fd)
        os.close(self.driver_fd)
        self.board_fd = None

    def time_ns(self, k):
        """Return when sample k is taken, by the host's monotonic clock, ns."""
        period_ns = 1e9 / self.rate * (1 + self.ppm * 1e-6)
        return self.origin_ns + self.halted_ns + round(k * period_ns)

    def turn(self):
        """Send what is due; return the time until the next frame, s."""
        self.take_commands()
        now = time.monotonic_ns()
        if now - self.informed_ns > 1e9 and self.write(self.encoder.info_frame()):
            self.informed_ns = now
        while self.time_ns(self.next_sample + self.block - 1) <= time.monotonic_ns():
            self.send_frame()
        due_ns = self.time_ns(self.next_sample + self.block - 1)
        return max(min((due_ns - time.monotonic_ns()) * 1e-9, 0.02), 0)

    def take_commands(self):
        try:
            received = os.read(self.board_fd, 4096)
        except (BlockingIOError, OSError):
            return
        for raw in self.received.split(received):
            with suppress(WireError):
                command = wire_format.decode_command(raw)
                if command.kind == wire_format.LATENCY_TYPE:
                    self.block = min(samples_within(command.time_us * 1e-6, self.rate), BLOCK)
                self.informed_ns = 0

    def send_frame(self):
        k = np.arange(self.next_sample, self.next_sample + self.block)
        codes = np.full((self.block, self.channels), 32768)
        codes[:, 0], codes[:, 1] = k % CODES + 1, mark(k)
        index = self.next_sample - self.first_sample
        raw = self.encoder.sample_frame(
            round(index * 1e6 / self.rate), index, codes.astype(np.uint16), self.overruns
        )
        if not self.write(raw):
            self.overruns += self.block
        self.next_sample += self.block

    def write(self, raw):
        """Write bytes with the present fault; return whether there was room."""
        if self.board_fd is None:
            return False
        self.flush()
        if self.unsent and not self.keeps:
            return False
        self.unsent += self.damage(raw)
        self.flush()
        return True

    def flush(self):
        with suppress(BlockingIOError):
            if self.unsent:
                self.unsent = self.unsent[os.write(self.board_fd, self.unsent) :]

    def damage(self, raw):
        draw = self.random
        if self.fault == 'baud':
            return bytes(draw.randrange(256) for _ in raw)
        if not self.fault:
            return raw
        out, burst = bytearray(), 0
        for byte in raw:
            if burst:
                burst -= 1
                out.append(draw.randrange(256))
            elif draw.random() >= self.fault_rate:
                out.append(byte)
            elif self.fault == 'flip':
                out.append(byte ^ 1 << draw.randrange(8))
            elif self.fault == 'insert':
                out += bytes([draw.randrange(256), byte])
            elif self.fault == 'burst':
                burst = draw.randrange(5, 60)
        return bytes(out)

    def write_all(self, raw):
        """Write all bytes, however long it takes; nothing else is sent meanwhile."""
        raw, self.unsent = self.unsent + raw, b''
        while raw:
            select.select([], [self.board_fd], [], 0.1)
            try:
                raw = raw[os.write(self.board_fd, raw[:4096]) :]
            except BlockingIOError:
                continue

    def obey(self, words):
        name, *rest = words
        number = float(rest[-1]) if rest else 0.0
        if name == 'fault':
            self.fault, self.fault_rate = rest[0], number
        elif name == 'clear':
            self.fault = ''
        elif name == 'noise':
            self.write_all(self.random.randbytes(int(number)))
        elif name == 'flat':
            self.write_all(b'\x55' * int(number))
        elif name == 'drop':
            self.next_sample += int(number)
            self.overruns += int(number)
        elif name == 'unplug':
            self.unplug()
            time.sleep(number)
            self.skip()
            self.plug()
        elif name == 'reset':
            time.sleep(number)
            self.skip()
            self.first_sample, self.overruns = self.next_sample, 0
            self.block = BLOCK
            self.encoder, self.informed_ns = Encoder(self.info), 0
        elif name == 'halt':
            time.sleep(number)
            self.halted_ns += round(number * 1e9)

    def skip(self):
        """Lose the frames that were due in the meantime."""
        while self.time_ns(self.next_sample + self.block - 1) <= time.monotonic_ns():
            self.next_sample += self.block
            self.overruns += self.block


def main():
    options = json.loads(sys.argv[2]) if len(sys.argv) > 2 else {}
    board = FaultyBoard(sys.argv[1], options)
    print(json.dumps({'origin_ns': board.origin_ns}), flush=True)
    wait_s = 0.0
    while True:
        if select.select([sys.stdin], [], [], wait_s)[0]:
            line = sys.stdin.readline()
            if not line:
                return
            board.obey(line.split())
            print(
                json.dumps({'done_ns': time.monotonic_ns(), 'next_sample': board.next_sample}),
                flush=True,
            )
        wait_s = board.turn()


if __name__ == '__main__':
    main()
