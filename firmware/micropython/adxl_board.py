# SPDX-License-Identifier: Apache-2.0

"""A board that sends the samples of a sensor over USB, in wire format 1."""

import select
import struct
import sys
import time

import adxl_frames
import micropython

_MOST_SAMPLES = 10  # Of a frame, and those before the first command
_TIMED_SAMPLES = 64  # Over which the rate of a chip is measured by the clock of the board
_SILENT_PERIODS = 50  # Without a new sample, after which a chip counts as gone
_INFO_US = 1_000_000  # Time between two descriptions of the board
_SETTLING_US = 200_000  # Time after a self-test for which samples are marked
_LONGEST_US = 5_000_000  # Longest time of a self-test without a new command
_AGAIN_MS = 200  # Pause before a chip that does not answer is tried again


class Board:
    """
    Reads a sensor and writes frames; a sample that is lost is counted.

    A chip samples by its own clock, so the board measures the rate and states what it has
    measured. Each new sample is read once, as soon as it is ready.
    """

    def __init__(self, sensor, serial_number):
        self._sensor = sensor
        self._encoder = adxl_frames.Encoder(
            serial_number,
            sensor.bits,
            sensor.vref_v,
            sensor.channels,
            adxl_frames.HAS_SELF_TEST if sensor.has_self_test else 0,
        )
        self._receiver = adxl_frames.Receiver()
        self._host = select.poll()
        self._host.register(sys.stdin, select.POLLIN)
        self._commands = {  # By the type of their frame
            adxl_frames.LATENCY: self._set_latency,
            adxl_frames.SELF_TEST: self._hold_self_test,
        }
        self._off_us = None  # When the self-test ends; None where none is on
        self._marked_us = 0  # Until when samples are marked
        self._rate_hz = 0.0
        self._wanted = _MOST_SAMPLES
        self._ticks, self._now_us = time.ticks_us(), 0
        self._due_us = None  # Time of the newest sample
        self._awake_us = 0  # When the sensor last worked
        self._index, self._overruns = -1, 0  # Number of the newest sample; samples that were lost
        self._block, self._block_us = [], 0  # Samples that are not sent, and the time of the first
        self._block_flags = 0
        self._informed_us = 0

    def run(self):
        """Send samples until mpremote stops the program; a chip that is lost is opened again."""
        micropython.kbd_intr(-1)  # a command of the driver may contain Ctrl-C
        while True:
            try:
                self._sensor.open()
                self._off_us = None
                self._awake_us = self._now()
                if not self._rate_hz:
                    self._measure_rate()
                    self._inform()
                while True:
                    self._step()
            except OSError as error:
                self._send()
                # Text is no frame, so that the driver skips it, but a person reads it.
                text = f'{type(self._sensor).__name__}: {error}: check power and wires\n'
                sys.stdout.buffer.write(text.encode() + b'\0')
                time.sleep_ms(_AGAIN_MS)
                self._listen()

    def _now(self):
        """Return the time since power-on, µs; the ticks of the board wrap, and this does not."""
        ticks = time.ticks_us()
        self._now_us += time.ticks_diff(ticks, self._ticks)
        self._ticks = ticks
        return self._now_us

    def _measure_rate(self):
        """Measure the rate of a sensor that samples by a clock of its own."""
        self._rate_hz = self._sensor.rate_hz
        if self._sensor.has_clock:
            first_us = last_us = self._wait()
            samples = 0
            while samples < _TIMED_SAMPLES:
                now_us = self._wait()
                # A sample that was too late to be read passes, too.
                samples += max(int((now_us - last_us) * self._sensor.rate_hz / 1e6 + 0.5), 1)
                last_us = now_us
            self._rate_hz = samples * 1e6 / (last_us - first_us)
        self._awake_us = self._now()

    def _wait(self):
        """Return the time of the next sample, which is not sent."""
        begin_us = now_us = self._now()
        while not self._sensor.ready(now_us):
            if now_us - begin_us > _SILENT_PERIODS * 1e6 / self._sensor.rate_hz:
                raise OSError('no sample')
            now_us = self._now()
        self._sensor.read()
        return now_us

    def _step(self):
        """Take a sample if there is one, and serve the host."""
        now_us, period_us = self._now(), 1e6 / self._rate_hz
        if self._off_us is not None and now_us >= self._off_us:
            self._end_self_test()
        if self._sensor.ready(now_us):
            self._take(now_us, self._sensor.read(), period_us)
        elif now_us - self._awake_us > _SILENT_PERIODS * period_us:
            raise OSError('no sample')
        self._listen()
        if now_us - self._informed_us > _INFO_US:
            self._inform()
        time.sleep_us(int(period_us / 32))

    def _take(self, now_us, codes, period_us):
        """Count a sample by its time, and send the block that it completes."""
        steps = 1
        if self._due_us is None:
            self._due_us = now_us
        else:
            # The board may see a sample late but never early, which smooths its time.
            steps = max(int((now_us - self._due_us) / period_us + 0.25), 1)
            self._due_us += int(steps * period_us + 0.5)
            self._due_us += (now_us - self._due_us) // 8
            self._due_us = min(self._due_us, now_us)
        if steps > 1:
            self._send()
        self._index += steps
        self._overruns += steps - 1
        self._awake_us = now_us
        if not self._block:
            self._block_us = self._due_us
        if now_us < self._marked_us:
            self._block_flags |= adxl_frames.IN_SELF_TEST
        self._block.append(codes)
        if len(self._block) >= self._wanted:
            self._send()

    def _send(self):
        """Send the samples of the block."""
        if self._block:
            first = self._index - len(self._block) + 1
            counts = self._block_us, first, self._overruns
            self._write(self._encoder.samples(*counts, self._block, self._block_flags))
            self._block, self._block_flags = [], 0

    def _inform(self):
        self._informed_us = self._now_us
        self._write(self._encoder.info(self._rate_hz))

    def _write(self, raw):
        sys.stdout.buffer.write(raw)

    def _listen(self):
        """Take the bytes of the host and obey its commands."""
        while self._host.poll(0):
            byte = sys.stdin.buffer.read(1)
            if not byte:
                return
            payload = self._receiver.take(byte[0])
            if payload and payload[0] in self._commands and self._rate_hz:
                if len(payload) == 12:
                    self._commands[payload[0]](struct.unpack('<I', payload[8:])[0])
                self._inform()

    def _set_latency(self, latency_us):
        """Collect the samples of so many µs in a frame."""
        samples = int(latency_us * self._rate_hz / 1e6 + 1e-3)
        self._wanted = min(max(samples, 1), _MOST_SAMPLES)

    def _hold_self_test(self, time_us):
        """Switch the self-test on for so many µs from now; 0 ends it."""
        if not self._sensor.has_self_test:
            return
        if not time_us:
            self._end_self_test()
            return
        if self._off_us is None:
            self._sensor.self_test(True)
        self._off_us = self._now() + min(time_us, _LONGEST_US)
        self._marked_us = self._off_us + _SETTLING_US

    def _end_self_test(self):
        if self._off_us is not None:
            self._off_us = None
            self._sensor.self_test(False)
            self._marked_us = self._now() + _SETTLING_US
