# SPDX-License-Identifier: Apache-2.0

"""
A small IIOD: the text protocol of libiio 0.x, with one ADC whose samples carry their numbers.

    python iiod.py '{"port": 0, "rate": 1000, "channels": [...]}'

It prints the port on which it listens. Channel c has `code(k, c, bits)` at sample k, and the time
stamp t0 + k / rate of the device's clock. Like a kernel without a reader, it keeps the samples of
its buffers and loses later ones.
"""

from collections import deque
import json
import socketserver
import sys
import time
from typing import NamedTuple

ATTRIBUTES = {
    'context': 'name version-major version-minor version-git description',
    'device': 'id name',
    'channel': 'id type',
    'attribute': 'name filename',
    'scan-element': 'index format',
}
"""Attributes of the elements of a context, by element."""


def declaration(element, attributes):
    """Return the declaration of an element in the document type of a context."""
    listed = ' '.join(f'{attribute} CDATA #IMPLIED' for attribute in attributes.split())
    return f'<!ELEMENT {element} ANY><!ATTLIST {element} {listed}>'


GRAMMAR = ''.join(declaration(*item) for item in ATTRIBUTES.items())
"""Document type of a context, which libiio demands."""
CHANNELS = [
    {'id': 'voltage0', 'label': 'x'},
    {'id': 'voltage1', 'label': 'y'},
    {'id': 'voltage2', 'label': 'supply'},
]
"""Channels without other ones in the options."""
FORMAT = 'le:u16/16>>0'
"""Format of a channel without another one."""
STAMP_FORMAT = 'le:S64/64>>0'
"""Format of the time stamps."""
DEFAULTS = {'scale': 0.0762939453125, 'raw': 100}
"""Attributes of a channel without other values; the scale is 5 V / 2^16 in mV."""
EIO, EINVAL = -5, -22
"""Error numbers of the protocol."""


def code(k, c, bits):
    """Return the right-aligned code, unsigned, of channel c at sample k."""
    return (k * (2 * c + 1) + 1000 * c) % (2**bits - 2) + 1


class Format(NamedTuple):
    """Byte order, signedness, used bits, stored bits and shift of a channel's codes."""

    order: str
    sign: str
    bits: int
    stored: int
    shift: int


def parse_format(channel):
    order, rest = channel.get('format', FORMAT).split(':')
    bits, rest = rest[1:].split('/')
    stored, shift = rest.split('>>')
    return Format(order, channel.get('format', FORMAT)[3], int(bits), int(stored), int(shift))


class Adc:
    """The device: its clock, its attributes, its buffer."""

    def __init__(self, options):
        self.options = options
        stated_hz = float(options.get('rate', 1000.0))
        self.share = options.get('share', 1.0)  # Of the stated rate at which it samples
        self.rate = self.share * stated_hz
        self.channels = [*options.get('channels', CHANNELS)]
        # libiio numbers the channels of the buffer first, with the time stamps as the last one.
        self.stamp_index = sum(not channel.get('unbuffered') for channel in self.channels)
        self.attributes = {
            'sampling_frequency': str(stated_hz),
            'current_timestamp_clock': 'realtime',
            **options.get('attributes', {}),
        }
        self.offset_ns = options.get('offset_ns', 7_000_000_000)
        self.drift = 1 + options.get('ppm', 0) * 1e-6
        # A server that is started again has the same device.
        self.began_ns = options.get('began_ns') or time.monotonic_ns()
        self.buffers, self.count = 4, 20
        self.next_sample = 0
        self.lost = 0
        # After how many samples how many are lost, again and again
        self.taken_of, self.lost_of = options.get('loses', (1, 0))
        self.enabled = []
        self.queue = deque()

    def sample_count(self):
        """Return how many samples have been taken, the one of the first instant included."""
        return int((time.monotonic_ns() - self.began_ns) * self.drift * self.rate * 1e-9) + 1

    def until_s(self, k):
        """Return the time until sample k is taken, s."""
        return (self.began_ns - time.monotonic_ns()) * 1e-9 + k / self.rate / self.drift

    def stamp(self, k):
        return self.began_ns + self.offset_ns + round(k * 1e9 / self.rate)

    def begin(self, count, mask):
        self.enabled = [i for i in range(self.stamp_index + 1) if mask >> i & 1]
        self.count, self.next_sample = count, self.sample_count()

    def samples(self, count):
        """Wait for samples and return their numbers."""
        numbers = []
        while len(numbers) < count:
            available, kept = self.sample_count(), self.buffers * self.count
            if available - self.next_sample > kept and not numbers:
                self.queue = deque(range(self.next_sample, self.next_sample + kept))
                self.lost += available - self.next_sample - kept
                self.next_sample = available
            while self.queue and len(numbers) < count:
                numbers.append(self.queue.popleft())
            while self.next_sample < available and len(numbers) < count:
                if self.next_sample % (self.taken_of + self.lost_of) < self.taken_of:
                    numbers.append(self.next_sample)
                self.next_sample += 1
            if len(numbers) < count:
                time.sleep(max(self.until_s(self.next_sample + count - len(numbers) - 1), 0))
        return numbers

    def packed(self, k):
        """Pack a sample as the kernel does: each element at a multiple of its size."""
        elements = [self.element(i, k) for i in self.enabled]
        out = b''
        for element in elements:
            out += b'\0' * (-len(out) % len(element)) + element
        return out + b'\0' * (-len(out) % max(map(len, elements)))

    def element(self, i, k):
        if i == self.stamp_index:
            return self.stamp(k).to_bytes(8, 'little', signed=True)
        form = parse_format(self.channels[i])
        value = code(k, i, form.bits)
        if form.sign == 's':
            value -= 2 ** (form.bits - 1)
        value = (value % 2**form.bits) << form.shift
        return value.to_bytes(form.stored // 8, 'big' if form.order == 'be' else 'little')

    def channel_xml(self, i):
        channel = self.channels[i]
        names = [
            name
            for name in ('label', 'offset', 'scale', 'raw')
            if name in channel or name in DEFAULTS
        ]
        attributes = ''.join(
            f'<attribute name="{name}" filename="in_{channel["id"]}_{name}" />' for name in names
        )
        scan = '' if channel.get('unbuffered') else scan_xml(i, channel.get('format', FORMAT))
        return f'<channel id="{channel["id"]}" type="input">{scan}{attributes}</channel>'

    def xml(self):
        channels = ''.join(map(self.channel_xml, range(len(self.channels))))
        stamp = (
            ''
            if self.options.get('unstamped')
            else (
                '<channel id="timestamp" type="input">'
                f'{scan_xml(self.stamp_index, STAMP_FORMAT)}</channel>'
            )
        )
        attributes = ''.join(f'<attribute name="{name}" />' for name in self.attributes)
        return (
            f'<?xml version="1.0" encoding="utf-8"?><!DOCTYPE context [{GRAMMAR}]>'
            '<context name="network" version-major="0" version-minor="24" '
            'version-git="v0.24" description="fixture">'
            f'<device id="iio:device0" name="adc">{channels}{stamp}{attributes}</device>'
            '</context>'
        ).encode()

    def read(self, words):
        """Return the text of an attribute, or an error number."""
        if words[0] in ('INPUT', 'OUTPUT'):
            channel = next(channel for channel in self.channels if channel['id'] == words[1])
            value = channel.get(words[2], DEFAULTS.get(words[2]))
        else:
            value = self.attributes.get(words[0])
        return EIO if value is None else str(value)

    def write(self, words, text):
        """Set an attribute; return the length of its text, or an error number."""
        if words[0] == 'sampling_frequency':
            permitted = self.options.get('rates')
            if permitted and float(text) not in permitted:
                return EINVAL
            self.rate = self.share * float(text)
        if words[0] not in self.attributes:
            return EIO
        self.attributes[words[0]] = text
        return len(text)


def scan_xml(index, form):
    """Return the element that places a channel in the buffer."""
    return f'<scan-element index="{index}" format="{form.replace(">>", "&gt;&gt;")}" />'


class Client(socketserver.StreamRequestHandler):
    """One connection; libiio has one for attributes and one for the buffer."""

    disable_nagle_algorithm = True

    def answer(self, number, data=b''):
        self.wfile.write(b'%d\n' % number + data)

    def handle(self):
        for line in self.rfile:
            words = line.decode().split()
            if words and words[0] == 'EXIT':
                return
            if words:
                self.obey(words[0], words[1:])

    def obey(self, command, rest):
        adc = self.server.adc
        time.sleep(adc.options.get('answer_s', 0.0))
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
            size = int(rest[1]) // len(adc.packed(0))
            data = b''.join(map(adc.packed, adc.samples(size)))
            self.answer(len(data), self.mask.encode() + b'\n' + data)
        elif command in ('CLOSE', 'TIMEOUT'):
            self.answer(0)
        else:
            self.answer(EINVAL)


class Server(socketserver.ThreadingTCPServer):
    """The server; it may bind a port that was just in use."""

    allow_reuse_address = True
    daemon_threads = True

    def handle_error(self, request, client_address):
        """Print nothing, because clients disconnect without notice."""


def main():
    options = json.loads(sys.argv[1]) if len(sys.argv) > 1 else {}
    with Server(('127.0.0.1', options.get('port', 0)), Client) as server:
        server.adc = Adc(options)
        print(server.server_address[1], flush=True)
        server.serve_forever()


if __name__ == '__main__':
    main()
