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
A small IIOD: the text protocol of libiio 0.x, with one ADC whose samples tell who they are.

    python iiod.py '{"port": 0, "rate": 1000, "channels": [...]}'

prints the port it listens on. Code of channel c at sample k: `code(k, c, bits)`; its time stamp
is t0 + k / rate of the device's clock. Like a kernel that nobody reads it keeps the samples of its
buffers, and loses those that come then.
"""

import json
import socketserver
import sys
import time

KNOWN = {'context': 'name version-major version-minor version-git description',
         'device': 'id name', 'channel': 'id type', 'attribute': 'name filename',
         'scan-element': 'index format'}
GRAMMAR = ''.join(
    f'<!ELEMENT {name} ANY><!ATTLIST {name} '
    + ' '.join(f'{attribute} CDATA #IMPLIED' for attribute in attributes.split()) + '>'
    for name, attributes in KNOWN.items())

CHANNELS = [{'id': 'voltage0', 'label': 'x'}, {'id': 'voltage1', 'label': 'y'},
            {'id': 'voltage2', 'label': 'supply'}]


def code(k, c, bits):
    """Return the right-aligned code, unsigned, of channel c at sample k."""
    return (k * (2 * c + 1) + 1000 * c) % (2 ** bits - 2) + 1


def format_of(channel):
    """Return byte order, signedness, used and stored bits and the shift of a channel."""
    text = channel.get('format', 'le:u16/16>>0')
    order, rest = text.split(':')
    bits, rest = rest[1:].split('/')
    stored, shift = rest.split('>>')
    return order, text[3], int(bits), int(stored), int(shift)


class Adc:
    """The device: its clock, its attributes, its buffer."""

    def __init__(self, setting):
        self.setting = setting
        self.rate = float(setting.get('rate', 1000.0))
        self.channels = [*setting.get('channels', CHANNELS)]
        # libiio numbers the channels of the buffer, its stamps last, before the others.
        self.last = sum(not c.get('unbuffered') for c in self.channels)
        self.attributes = {'sampling_frequency': str(self.rate),
                           'current_timestamp_clock': 'realtime', **setting.get('attributes', {})}
        self.offset_ns = setting.get('offset_ns', 7_000_000_000)
        self.drift = 1 + setting.get('ppm', 0) * 1e-6
        # A server that is started anew finds the same device.
        self.began_ns = setting.get('began_ns') or time.monotonic_ns()
        self.buffers, self.count = 4, 20
        self.next = 0
        self.lost = 0
        self.enabled = []

    def now(self):
        """Return how many samples have been taken."""
        return int((time.monotonic_ns() - self.began_ns) * self.drift * self.rate * 1e-9)

    def stamp(self, k):
        return self.began_ns + self.offset_ns + round(k * 1e9 / self.rate)

    def begin(self, count, mask):
        self.enabled = [i for i in range(self.last + 1) if mask >> i & 1]
        self.count, self.next = count, self.now()

    def samples(self, count):
        """Wait for samples and return their numbers."""
        numbers = []
        while len(numbers) < count:
            now, kept = self.now(), self.buffers * self.count
            if now - self.next > kept and not numbers:
                self.queue = list(range(self.next, self.next + kept))
                self.lost += now - self.next - kept
                self.next = now
            queue = getattr(self, 'queue', [])
            while queue and len(numbers) < count:
                numbers.append(queue.pop(0))
            while self.next < now and len(numbers) < count:
                numbers.append(self.next)
                self.next += 1
            if len(numbers) < count:
                time.sleep(0.001)
        return numbers

    def packed(self, k):
        """Lay a sample out as the kernel does: each element at a multiple of its size."""
        out = b''
        for i in self.enabled:
            if i == self.last:
                size, order, value = 8, 'le', self.stamp(k)
            else:
                order, sign, bits, stored, shift = format_of(self.channels[i])
                size, value = stored // 8, code(k, i, bits)
                if sign == 's':
                    value -= 2 ** (bits - 1)
                value = (value % 2 ** bits) << shift
            out += b'\0' * (-len(out) % size)
            signed = i == self.last
            out += value.to_bytes(size, 'big' if order == 'be' else 'little', signed=signed)
        largest = max(8 if i == self.last else format_of(self.channels[i])[3] // 8
                      for i in self.enabled)
        return out + b'\0' * (-len(out) % largest)

    def xml(self):
        def attribute(channel, name):
            return f'<attribute name="{name}" filename="in_{channel["id"]}_{name}" />'

        parts = []
        for i, c in enumerate(self.channels):
            scan = '' if c.get('unbuffered') else \
                f'<scan-element index="{i}" format="{c.get("format", "le:u16/16>>0")}" />'
            names = [n for n in ('label', 'offset', 'scale', 'raw')
                     if n in c or n == 'raw' or (n == 'scale' and 'scale' not in c)]
            parts.append(f'<channel id="{c["id"]}" type="input">'.replace('>>', '&gt;&gt;')
                         + scan.replace('>>', '&gt;&gt;')
                         + ''.join(attribute(c, n) for n in names) + '</channel>')
        stamp = '' if self.setting.get('unstamped') else (
            '<channel id="timestamp" type="input"><scan-element index='
            f'"{self.last}" format="le:S64/64&gt;&gt;0" /></channel>')
        own = ''.join(f'<attribute name="{n}" />' for n in self.attributes)
        return ('<?xml version="1.0" encoding="utf-8"?><!DOCTYPE context ['
                + GRAMMAR + ']>'
                '<context name="network" version-major="0" version-minor="24" '
                'version-git="v0.24" description="fixture">'
                f'<device id="iio:device0" name="adc">{"".join(parts)}{stamp}{own}</device>'
                '</context>').encode()

    def read(self, words):
        """Return an attribute's text, or an error number."""
        if words[0] in ('INPUT', 'OUTPUT'):
            channel = next(c for c in self.channels if c['id'] == words[1])
            value = channel.get(words[2], {'scale': 0.0762939453125, 'raw': 100}.get(words[2]))
        else:
            value = self.attributes.get(words[0])
        return -5 if value is None else str(value)

    def write(self, words, text):
        if words[0] == 'sampling_frequency':
            allowed = self.setting.get('rates')
            if allowed and float(text) not in allowed:
                return -22
            self.rate = float(text)
        if words[0] not in self.attributes:
            return -5
        self.attributes[words[0]] = text
        return len(text)


class Client(socketserver.StreamRequestHandler):
    """One connection; libiio has one for attributes and one for the buffer."""

    disable_nagle_algorithm = True

    def answer(self, number, data=b''):
        self.wfile.write(b'%d\n' % number + data)

    def handle(self):
        adc = self.server.adc
        for line in self.rfile:
            words = line.decode().split()
            if not words:
                continue
            command, rest = words[0], words[1:]
            if command == 'VERSION':
                self.wfile.write(b'0.24.v0.24  \n')
            elif command == 'PRINT':
                self.answer(len(adc.xml()), adc.xml() + b'\n')
            elif command == 'READ':
                value = adc.read(rest[1:])
                if isinstance(value, int):
                    self.answer(value)
                else:
                    self.answer(len(value) + 1, value.encode() + b'\0\n')
            elif command == 'WRITE':
                text = self.rfile.read(int(rest[-1])).rstrip(b'\0').decode()
                self.answer(adc.write(rest[1:-1], text))
            elif command == 'SET':
                adc.buffers = int(rest[-1])
                self.answer(0)
            elif command == 'OPEN':
                adc.begin(int(rest[1]), int(rest[2], 16))
                self.mask = rest[2]
                self.answer(0)
            elif command == 'READBUF':
                size = int(rest[1])
                per_sample = len(adc.packed(0))
                data = b''.join(map(adc.packed, adc.samples(size // per_sample)))
                self.answer(len(data), self.mask.encode() + b'\n' + data)
            elif command in ('CLOSE', 'TIMEOUT'):
                self.answer(0)
            elif command == 'EXIT':
                return
            else:
                self.answer(-22)


class Server(socketserver.ThreadingTCPServer):
    """The server; a port that was just in use is taken again."""

    allow_reuse_address = True
    daemon_threads = True

    def handle_error(self, request, client_address):
        """Say nothing: a client that has gone is no news."""


def main():
    setting = json.loads(sys.argv[1]) if len(sys.argv) > 1 else {}
    with Server(('127.0.0.1', setting.get('port', 0)), Client) as server:
        server.adc = Adc(setting)
        print(server.server_address[1], flush=True)
        server.serve_forever()


if __name__ == '__main__':
    main()
