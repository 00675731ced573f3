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

"""The encoder of the firmware, compiled on the host, against the reference encoder."""

import ctypes
import shutil
import subprocess

from adxl_ros.links.support.wire_format import AFTER_RESET, BoardInfo, decode, Encoder, RAIL
import numpy as np
from processes import REPO
import pytest

SOURCE = REPO / 'firmware' / 'adxl_board' / 'frame.c'


class Counts(ctypes.Structure):
    """`struct frame_counts` of frame.h."""

    _fields_ = [('block_seq', ctypes.c_uint32), ('flags', ctypes.c_uint16)]


@pytest.fixture(scope='module')
def library(tmp_path_factory):
    """Compile frame.c and load it."""
    compiler = shutil.which('cc') or shutil.which('gcc') or shutil.which('clang')
    if compiler is None:
        pytest.skip('no C compiler: apt install gcc')
    made = tmp_path_factory.mktemp('firmware') / 'frame.so'
    subprocess.run([compiler, '-std=c99', '-Wall', '-Wextra', '-Werror', '-pedantic', '-shared',
                    '-fPIC', '-o', made, SOURCE], check=True)
    library = ctypes.CDLL(str(made))
    library.frame_data.restype = library.frame_info.restype = ctypes.c_size_t
    return library


def data(library, counts, time_us, index, overruns, codes, bits=16):
    """Encode a frame of samples by the firmware, and check that it stays within its room."""
    count, channels = codes.shape
    room = 24 + 2 * codes.size + 4 + (28 + 2 * codes.size) // 254 + 2
    out = (ctypes.c_uint8 * (room + 8))(*[0xAA] * (room + 8))
    flat = (ctypes.c_uint16 * codes.size)(*codes.ravel().tolist())
    length = library.frame_data(
        ctypes.byref(counts), ctypes.c_uint64(time_us), ctypes.c_uint32(index),
        ctypes.c_uint16(overruns), ctypes.c_uint8(count), ctypes.c_uint8(channels), flat,
        ctypes.c_uint8(bits), out)
    assert length <= room
    assert set(out[length:]) == {0xAA}, 'no byte beyond the frame'
    return bytes(out[:length])


def test_the_vector_of_the_interfaces(library):
    codes = np.array([[0x8000, 0], [0x1234, 0xffff]])
    frame = data(library, Counts(7, 0), 1_000_000, 70, 0, codes)
    vector = bytes.fromhex('03010101020701010440420f01010101024601010101030202028001093412ffff'
                           'e9e413f100')
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
    length = library.frame_info(ctypes.byref(counts), ctypes.c_float(1000.0), ctypes.c_uint8(16),
                                ctypes.c_uint8(3), ctypes.c_float(5.0), b'adxl-0001', out)
    assert bytes(out[:length]) == reference.info_frame()
    for _ in range(500):
        count, channels = int(rng.integers(1, 60)), int(rng.integers(1, 5))
        # Few zeros make long runs without one, which COBS cuts at 254 bytes.
        codes = rng.integers(1, 2 ** 16, (count, channels)) | (0x0101 * int(rng.integers(2)))
        time_us, index = int(rng.integers(2 ** 53)), int(rng.integers(2 ** 32))
        actual = data(library, counts, time_us, index, count, codes)
        expected = reference.sample_frame(time_us, index, codes, count)
        assert actual.count(b'\0') == 1
        decoded = decode(actual[:-1])
        assert decoded.check == decode(expected[:-1]).check
        assert np.array_equal(decoded.codes, codes)
        assert len(actual) - len(expected) in (0, 1), 'a last run of 254 may be closed twice'
