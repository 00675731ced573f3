# SPDX-License-Identifier: Apache-2.0

"""The firmware, compiled on the host: its frames, its commands, its sketch on a terminal."""

from contextlib import contextmanager
import ctypes
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
    Command,
    decode,
    encode_command,
    Encoder,
    LATENCY_TYPE,
    RAIL,
    SELF_TEST_TYPE,
    unstuff,
)
from hypothesis import given, settings, strategies as st
from needs import lack
import numpy as np
from processes import PATIENCE, REPO
import pytest
from units import nominal

FOLDER = REPO / 'firmware' / 'adxl_board'
SOURCE = FOLDER / 'frame.c'


class Receiver(ctypes.Structure):
    """`struct frame_receiver` of frame.h."""

    _fields_ = [('raw', ctypes.c_uint8 * 17), ('length', ctypes.c_uint8)]


class Counts(ctypes.Structure):
    """`struct frame_counts` of frame.h."""

    _fields_ = [('block_seq', ctypes.c_uint32), ('flags', ctypes.c_uint16)]


@pytest.fixture(scope='module')
def library(made_once):
    compiler = shutil.which('cc') or shutil.which('gcc') or shutil.which('clang')
    if compiler is None:
        pytest.skip(lack('a C compiler', 'gcc'))
    folder = made_once(
        'firmware',
        lambda folder: subprocess.run(
            [
                compiler,
                '-std=c99',
                '-Wall',
                '-Wextra',
                '-Werror',
                '-pedantic',
                '-shared',
                '-fPIC',
                '-o',
                folder / 'frame.so',
                SOURCE,
            ],
            check=True,
        ),
    )
    library = ctypes.CDLL(str(folder / 'frame.so'))
    library.frame_data.restype = library.frame_info.restype = ctypes.c_size_t
    library.frame_samples.restype = ctypes.c_uint8
    return library


def data(library, counts, time_us, index, overruns, codes, bits=16):
    count, channels = codes.shape
    room = 24 + 2 * codes.size + 4 + (28 + 2 * codes.size) // 254 + 2
    out = (ctypes.c_uint8 * (room + 8))(*[0xAA] * (room + 8))
    flat = (ctypes.c_uint16 * codes.size)(*codes.ravel().tolist())
    length = library.frame_data(
        ctypes.byref(counts),
        ctypes.c_uint64(time_us),
        ctypes.c_uint32(index),
        ctypes.c_uint16(overruns),
        ctypes.c_uint8(count),
        ctypes.c_uint8(channels),
        flat,
        ctypes.c_uint8(bits),
        out,
    )
    assert length <= room
    assert set(out[length:]) == {0xAA}, 'no byte beyond the frame'
    return bytes(out[:length])


def test_the_vector_of_the_interfaces(library):
    codes = np.array([[0x8000, 0], [0x1234, 0xFFFF]])
    frame = data(library, Counts(7, 0), 1_000_000, 70, 0, codes)
    vector = bytes.fromhex(
        '03010101020701010440420f01010101024601010101030202028001093412ffffe9e413f100'
    )
    assert decode(vector[:-1]).flags == 0
    decoded = decode(frame[:-1])
    assert decoded.flags == RAIL
    assert np.array_equal(decoded.codes, codes)
    assert (decoded.sequence, decoded.time_us, decoded.index) == (7, 1_000_000, 70)


def test_every_frame_equals_that_of_the_reference(library):
    rng = np.random.default_rng(1)
    info = BoardInfo(1000.0, 16, 3, 5.0, 'adxl-0001')
    reference, counts = Encoder(info), Counts(0, AFTER_RESET)
    out = (ctypes.c_uint8 * 64)()
    length = library.frame_info(
        ctypes.byref(counts),
        ctypes.c_float(1000.0),
        ctypes.c_uint8(16),
        ctypes.c_uint8(3),
        ctypes.c_float(5.0),
        b'adxl-0001',
        out,
    )
    assert bytes(out[:length]) == reference.info_frame()
    for _ in range(500):
        count, channels = int(rng.integers(1, 60)), int(rng.integers(1, 5))
        # Few zeros make long runs without one, which COBS cuts at 254 bytes.
        codes = rng.integers(1, 2**16, (count, channels)) | (0x0101 * int(rng.integers(2)))
        time_us, index = int(rng.integers(2**53)), int(rng.integers(2**32))
        actual = data(library, counts, time_us, index, count, codes)
        expected = reference.sample_frame(time_us, index, codes, count)
        assert actual.count(b'\0') == 1
        assert unstuff(actual[:-1]) == unstuff(expected[:-1])
        assert np.array_equal(decode(actual[:-1]).codes, codes)
        assert len(actual) - len(expected) in (0, 1), 'a last run of 254 may be closed twice'


def received(library, raw, receiver=None):
    """Return the commands in some bytes, as the firmware takes them."""
    receiver, time_us, commands = receiver or Receiver(), ctypes.c_uint32(), []
    for byte in raw:
        kind = library.frame_command(
            ctypes.byref(receiver), ctypes.c_uint8(byte), ctypes.byref(time_us)
        )
        if kind:
            commands.append(Command(kind, time_us.value))
    return commands


@settings(deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=40), st.binary(min_size=17, max_size=17))))
def test_no_stream_breaks_the_receiver(library, parts):
    receiver = Receiver()
    for part in parts:
        received(library, part.replace(b'\0', b'\1') + b'\0', receiver)
        assert receiver.length <= 18
    assert received(
        library,
        encode_command(0, 7)
        + encode_command(1, 8, 5)
        + encode_command(2, 500_000, SELF_TEST_TYPE),
        receiver,
    ) == [Command(LATENCY_TYPE, 7), Command(SELF_TEST_TYPE, 500_000)]


@pytest.fixture(scope='module')
def sketch(made_once):
    compiler = shutil.which('g++') or shutil.which('clang++')
    if compiler is None:
        pytest.skip(lack('a C++ compiler', 'g++'))
    return (
        made_once(
            'sketch',
            lambda folder: subprocess.run(
                [
                    compiler,
                    '-std=c++17',
                    '-O1',
                    '-Wall',
                    '-Wextra',
                    '-Werror',
                    '-pthread',
                    '-DST_PIN=9',
                    '-x',
                    'c++',
                    '-I',
                    REPO / 'test' / 'support' / 'arduino',
                    '-I',
                    FOLDER,
                    FOLDER / 'adxl_board.ino',
                    SOURCE,
                    '-o',
                    folder / 'sketch',
                ],
                check=True,
            ),
        )
        / 'sketch'
    )


@contextmanager
def running_sketch(sketch, tmp_path, baud, **parameters):
    board_fd, driver_fd = pty.openpty()
    tty.setraw(driver_fd)
    (tmp_path / 'port').symlink_to(os.ttyname(driver_fd))
    board = subprocess.Popen([sketch, str(board_fd), str(baud)], pass_fds=[board_fd])
    link = serial.open_link(
        nominal(),
        serial.Settings(port=str(tmp_path / 'port'), channels='x,y,supply', **parameters),
    )
    try:
        yield link
    finally:
        link.close()
        board.kill()
        board.wait()
        os.close(board_fd)
        os.close(driver_fd)


def read_until(link, condition, timeout_s=10.0 * PATIENCE):
    """Read a link until a condition holds; return volts, (n, m), and the number of lost ones."""
    volts, missing, end_s = [], 0, time.monotonic() + timeout_s
    while not condition():
        samples = link.read(0)
        volts.append(samples.volts)
        missing += samples.missing
        assert time.monotonic() < end_s, link.status()
    return np.concatenate(volts), missing


def value(link, name):
    return link.status().statistics[name]


@pytest.mark.parametrize('latency_ms', [0.0, 2.0, 5.0, 100.0])
def test_the_sketch_obeys(sketch, tmp_path, latency_ms):
    with running_sketch(sketch, tmp_path, 0, latency_ms=latency_ms) as link:
        frame_ms = min(max(latency_ms, 1.0), 10.0)
        read_until(link, lambda: value(link, 'frame_ms') == frame_ms and link.sensor)
        frames = value(link, 'frames')
        # A test that is held up finds the port silent until it reads again.
        read_until(
            link, lambda: value(link, 'frames') > frames + 30 and link.status().text == 'streaming'
        )
        assert link.sensor.serial == 'adxl-0001'


def test_the_sketch_ends_a_self_test_by_itself(sketch, tmp_path):
    """The pin is high for as long as the command says; each sample that it changes is marked."""
    with running_sketch(sketch, tmp_path, 0, latency_ms=2.0) as link:
        read_until(link, lambda: link.sensor)
        link.hold_self_test(0.3)
        codes, is_marked, end_s = [], [], time.monotonic() + 10 * PATIENCE
        while not any(is_marked) or any(is_marked[-50:]):
            assert time.monotonic() < end_s, link.status()
            samples = link.read(0)
            if len(samples.volts):
                codes += np.rint(samples.volts[:, 0] / 5.0 * 65536).astype(int).tolist()
                marks = samples.in_self_test
                is_marked += [False] * len(samples.volts) if marks is None else marks.tolist()
            assert not samples.missing
    step = (np.array(codes) - codes[-1] + np.arange(len(codes))[::-1]) % 65534
    is_changed = step > 0
    assert set(step.tolist()) == {0, 7000}
    assert not (is_changed & ~np.array(is_marked)).any()
    # At 1 kHz the pin is high for 300 samples, of which the last is taken after it has fallen.
    # 200 further ones may still settle. Whole frames are marked: at either end a frame of ten may
    # hold up to nine samples of before or after.
    assert is_changed.sum() == 299
    assert 300 + 200 <= sum(is_marked) <= 300 + 200 + 2 * 9
