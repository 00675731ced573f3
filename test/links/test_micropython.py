# SPDX-License-Identifier: Apache-2.0

"""The program for MicroPython on its unix port, with emulated chips, read byte by byte."""

from contextlib import contextmanager
from dataclasses import replace
import os
import pty
import shutil
import subprocess
import time
import tty

from adxl_ros.links import serial
from adxl_ros.links.support.wire_format import (
    AFTER_RESET,
    BoardInfo,
    decode,
    encode_command,
    encode_payload,
    Encoder,
    HAS_SELF_TEST,
    IN_SELF_TEST,
    SampleFrame,
    SELF_TEST_TYPE,
    Splitter,
    WireError,
)
from needs import lack
import numpy as np
from processes import PATIENCE, REPO
import pytest
from units import nominal

CHIPS = REPO / 'test' / 'support' / 'micropython_chips.py'
RATE_HZ = 97.0  # Of the clock of an emulated chip, which states 100, 104 or 125 Hz
MICROPYTHON = shutil.which('micropython')
pytestmark = pytest.mark.skipif(
    MICROPYTHON is None, reason=lack("MicroPython's unix port", 'micropython')
)


class Chip:
    """What a sensor sends at 1 g on z."""

    def __init__(self, bits, vref_v, one_g, y, warm=True):
        self.bits, self.vref_v, self.one_g, self.y, self.warm = bits, vref_v, one_g, y, warm


SENT = {
    'adxl345': Chip(10, 4.0, 256, -300, warm=False),
    'adxl355': Chip(16, 4.096, 16000, -19),  # -300 of 20 bits are -18.75 of 16
    'lsm6dso': Chip(16, 3.997696, 16393, -300),
    'mpu6050': Chip(16, 4.0, 16384, -300),
}


@contextmanager
def running_board(name, loose=(-1, 0), kind='simulated'):
    """Run the program on a terminal; yield its process, and the file and name of the other end."""
    board, host = pty.openpty()
    tty.setraw(host)
    arguments = [name, RATE_HZ, *loose, REPO / 'firmware' / 'micropython', kind]
    process = subprocess.Popen(
        [MICROPYTHON, CHIPS, *map(str, arguments)],
        stdin=board,
        stdout=board,
        stderr=subprocess.PIPE,
    )
    os.set_blocking(host, False)
    try:
        yield process, host, os.ttyname(host)
    finally:
        process.kill()
        process.communicate()
        os.close(host)
        os.close(board)


class Reader:
    """Reads the frames of a board, and keeps their bytes."""

    def __init__(self, host):
        self._host, self._splitter = host, Splitter()
        self.runs, self.frames, self.text = [], [], b''

    def until(self, condition):
        """Read until a condition holds."""
        end_s = time.monotonic() + 10.0 * PATIENCE
        while not condition(self.frames):
            assert time.monotonic() < end_s, (self.frames[-3:], self.text)
            try:
                chunk = os.read(self._host, 65536)
            except BlockingIOError:
                time.sleep(0.005)
                continue
            for run in self._splitter.split(chunk):
                try:
                    self.frames.append(decode(run))
                    self.runs.append(run)
                except WireError:
                    self.text += run


def samples_of(frames):
    return [frame for frame in frames if isinstance(frame, SampleFrame)]


@pytest.mark.parametrize('name', SENT)
def test_each_frame_is_that_of_the_reference_encoder(name):
    sent = SENT[name]
    with running_board(name) as (_, host, _):
        reader = Reader(host)
        reader.until(lambda frames: len(samples_of(frames)) >= 12)
    info = reader.frames[0]
    channels = 4 if sent.warm else 3
    assert (info.bits, info.channels, info.serial) == (sent.bits, channels, 'adxl-0001')
    assert info.vref_v == pytest.approx(sent.vref_v, rel=1e-6)
    assert info.rate_hz == pytest.approx(RATE_HZ, rel=1e-3)
    assert info.flags == AFTER_RESET | HAS_SELF_TEST and reader.text == b''
    reference = Encoder(replace(info, flags=HAS_SELF_TEST))
    for frame, run in zip(reader.frames, reader.runs):
        if isinstance(frame, BoardInfo):
            expected = reference.info_frame()
        else:
            expected = reference.sample_frame(
                frame.time_us, frame.index, frame.codes, frame.overruns
            )
        assert run + b'\0' == expected
    codes = np.concatenate([frame.codes for frame in samples_of(reader.frames)]).astype(int)
    numbers = np.concatenate(
        [frame.index + np.arange(len(frame.codes)) for frame in samples_of(reader.frames)]
    )
    middle = 2 ** (sent.bits - 1)
    assert set(codes[:, 1] - middle) == {sent.y} and set(codes[:, 2] - middle) == {sent.one_g}
    # The number in x says which sample it is: each one comes once.
    assert set(np.diff(codes[:, 0]) % 100) == set(np.diff(numbers)) == {1}
    stamps_us = np.array([frame.time_us for frame in samples_of(reader.frames)])
    assert np.diff(stamps_us) == pytest.approx(10e6 / RATE_HZ, abs=500)
    if sent.warm:
        warm_c = (codes[:, 3] * sent.vref_v / 2**sent.bits - 0.5) / 0.01
        assert warm_c == pytest.approx(31.5, abs=0.1)


def test_an_analog_sensor_is_read_in_sixteenths_of_a_step():
    with running_board('adxl335') as (_, host, _):
        reader = Reader(host)
        reader.until(lambda frames: len(samples_of(frames)) >= 2)
    volts = samples_of(reader.frames)[0].codes * 3.3 / 65536
    assert reader.frames[0].rate_hz == 100.0
    assert volts[0] == pytest.approx([1.65, 1.60, 1.98], abs=1e-3)


@pytest.mark.parametrize('name', [*SENT, 'adxl335'])
def test_a_self_test_ends_by_itself(name):
    with running_board(name) as (_, host, _):
        reader = Reader(host)
        reader.until(lambda frames: len(samples_of(frames)) >= 1)
        os.write(host, encode_command(1, 500_000, SELF_TEST_TYPE))
        reader.until(
            lambda frames: (
                any(frame.flags & IN_SELF_TEST for frame in samples_of(frames))
                and not samples_of(frames)[-1].flags & IN_SELF_TEST
            )
        )
    frames = samples_of(reader.frames)
    marks = [bool(frame.flags & IN_SELF_TEST) for frame in frames]
    rest = frames[0].codes[0, 1]
    changed = [int((frame.codes[:, 1] != rest).sum()) for frame in frames]
    assert all(mark or not count for mark, count in zip(marks, changed))
    rate_hz = reader.frames[0].rate_hz
    assert sum(changed) == pytest.approx(0.5 * rate_hz, abs=2)
    # Whole frames are marked, of ten samples each.
    assert 10 * sum(marks) == pytest.approx(0.7 * rate_hz + 10, abs=10)


def test_commands_are_obeyed_and_other_bytes_are_not():
    with running_board('mpu6050') as (process, host, _):
        reader = Reader(host)
        reader.until(lambda frames: len(samples_of(frames)) >= 1)
        assert len(samples_of(reader.frames)[0].codes) == 10
        os.write(host, b'\0\3\1\2\3garbage' * 9 + b'\0' + encode_payload(b'\3\1' + bytes(20)))
        os.write(host, encode_command(7, 0))
        reader.until(lambda frames: len(samples_of(frames)[-1].codes) == 1)
        os.write(host, encode_command(8, 31_000))
        reader.until(lambda frames: len(samples_of(frames)[-1].codes) in (2, 3))
        informed = [
            reader.frames[i + 1]
            for i, frame in enumerate(reader.frames[:-1])
            if isinstance(frame, BoardInfo) and i
        ]
        assert informed, 'an info frame is the answer'
        os.write(host, b'\0\r\x03')
        _, errors = process.communicate(timeout=10 * PATIENCE)
        assert b'KeyboardInterrupt' in errors


@pytest.mark.parametrize('name', ['lsm6dso', 'adxl355'])
def test_a_chip_that_comes_off_is_named_and_opened_again(name):
    with running_board(name, loose=(140, 80)) as (_, host, _):
        reader = Reader(host)
        reader.until(
            lambda frames: (
                len(samples_of(frames)) > 3
                and samples_of(frames)[-1].overruns > 50
                and len(samples_of(frames)[-1].codes) == 10
            )
        )
    assert b'check power and wires' in reader.text
    frames = samples_of(reader.frames)
    # Time goes on, and the count with it.
    rate_hz = reader.frames[0].rate_hz
    first, last = frames[0], frames[-1]
    elapsed_s = (last.time_us - first.time_us) * 1e-6
    assert last.index - first.index == pytest.approx(elapsed_s * rate_hz, abs=1.5)


def test_the_driver_reads_the_board():
    settings = {'channels': 'x,y,z,temperature', 'latency_ms': 20.0}
    with running_board('mpu6050', kind='real') as (_, _, port):
        link = serial.open_link(nominal(axes='xyz'), serial.Settings(port=port, **settings))
        try:
            volts, end_s = [], time.monotonic() + 10 * PATIENCE
            while sum(map(len, volts)) < 60:
                assert time.monotonic() < end_s, link.status()
                samples = link.read(0)
                volts.append(samples.volts)
            read = np.concatenate(volts)
            assert read[:, 2] == pytest.approx(3.0, abs=1e-4)
            assert link.sensor.adc_vref_v == 4.0 and link.sensor.serial == 'adxl-0001'
            assert link.status().statistics['resets'] == 0
        finally:
            link.close()
