# SPDX-License-Identifier: Apache-2.0

"""The serial wire format: its test vector, invalid frames, arbitrary streams of bytes."""

from dataclasses import replace
import zlib

from adxl_ros.links.support.wire_format import (
    AFTER_RESET,
    BoardInfo,
    Command,
    decode,
    decode_command,
    encode_command,
    encode_payload,
    Encoder,
    HAS_SELF_TEST,
    IN_SELF_TEST,
    LATENCY_TYPE,
    RAIL,
    SampleFrame,
    SELF_TEST_TYPE,
    Splitter,
    WireError,
)
from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

PAYLOAD = bytes.fromhex('010100000700000040420f00000000004600000000000202008000003412ffff')
FRAME = bytes.fromhex(
    '03010101020701010440420f01010101024601010101030202028001093412ffffe9e413f100'
)
INFO = BoardInfo(1000.0, 16, 2, 5.0, 'A7')


def test_the_vector_is_encoded_and_decoded():
    assert zlib.crc32(PAYLOAD).to_bytes(4, 'little') == bytes.fromhex('e9e413f1')
    assert encode_payload(PAYLOAD) == FRAME
    data = decode(FRAME[:-1])
    assert (data.flags, data.sequence, data.time_us, data.index, data.overruns) == (
        0,
        7,
        1_000_000,
        70,
        0,
    )
    assert data.codes.tolist() == [[0x8000, 0], [0x1234, 0xFFFF]]


def test_the_vector_of_a_command():
    payload = bytes.fromhex('0301000007000000d0070000')
    assert zlib.crc32(payload).to_bytes(4, 'little') == bytes.fromhex('5a6d1be4')
    frame = bytes.fromhex('00030301010207010103d00701055a6d1be400')
    assert encode_command(7, 2000) == frame
    assert decode_command(frame[1:-1]) == Command(LATENCY_TYPE, 2000)
    # The self-test for half a second
    payload = bytes.fromhex('040100000800000020a10700')
    assert zlib.crc32(payload).to_bytes(4, 'little') == bytes.fromhex('cb37715d')
    frame = bytes.fromhex('0003040101020801010420a10705cb37715d00')
    assert encode_command(8, 500_000, SELF_TEST_TYPE) == frame
    assert decode_command(frame[1:-1]) == Command(SELF_TEST_TYPE, 500_000)


def test_the_marks_of_the_self_test():
    encoder = Encoder(replace(INFO, flags=HAS_SELF_TEST))
    assert decode(encoder.info_frame()[:-1]).flags == AFTER_RESET | HAS_SELF_TEST
    codes = np.array([[7, 7]], np.uint16)
    marked = encoder.sample_frame(0, 0, codes, flags=IN_SELF_TEST)
    assert decode(marked[:-1]).flags == AFTER_RESET | IN_SELF_TEST
    assert decode(encoder.sample_frame(0, 1, codes)[:-1]).flags == 0
    with pytest.raises(WireError):
        decode_command(marked[:-1])


def test_the_encoder_makes_the_vector_and_sets_flags():
    encoder = Encoder(INFO)
    for _ in range(7):
        encoder.info_frame()
    made = decode(
        encoder.sample_frame(1_000_000, 70, np.array([[0x8000, 0], [0x1234, 0xFFFF]]))[:-1]
    )
    assert made.flags == RAIL | AFTER_RESET
    assert replace(made, flags=0, codes=None) == replace(decode(FRAME[:-1]), codes=None)


@pytest.mark.parametrize(
    'change',
    [
        lambda p: p[:1] + b'\2' + p[2:],
        lambda p: b'\3' + p[1:],
        lambda p: p[:-1],
        lambda p: p[:22] + b'\3' + p[23:],
        lambda p: p[:8] + b'\xff' * 8 + p[16:],
        lambda p: p[:6],
    ],
    ids=['version', 'type', 'length', 'count', 'time', 'head'],
)
def test_an_invalid_payload_is_refused(change):
    with pytest.raises(WireError):
        decode(encode_payload(change(PAYLOAD))[:-1])


def test_a_single_changed_lost_or_added_byte_never_decodes():
    rng = np.random.default_rng(0)
    raw = FRAME[:-1]
    for _ in range(3000):
        k, byte = int(rng.integers(len(raw))), bytes([rng.integers(256)])
        for bad in (
            raw[:k] + byte + raw[k + 1 :],
            raw[:k] + raw[k + 1 :],
            raw[:k] + byte + raw[k:],
        ):
            for part in bad.split(b'\0'):
                if part == raw:
                    continue
                with pytest.raises(WireError):
                    decode(part)


@settings(max_examples=300)
@given(st.binary(max_size=400))
def test_any_bytes_are_a_frame_or_an_error(raw):
    try:
        frame = decode(raw)
    except WireError:
        return
    assert isinstance(frame, BoardInfo | SampleFrame)


@settings(max_examples=200)
@given(
    st.lists(st.one_of(st.binary(max_size=50), st.just(FRAME)), max_size=20), st.integers(1, 30)
)
def test_the_size_of_chunks_changes_nothing(parts, size):
    stream = b''.join(parts) + b'\0'
    splitter = Splitter()
    pieces = [
        raw for i in range(0, len(stream), size) for raw in splitter.split(stream[i : i + size])
    ]
    assert pieces == Splitter().split(stream)


@settings(max_examples=200)
@given(
    st.integers(1, 12),
    st.integers(1, 8),
    st.integers(0, 2**53),
    st.integers(0, 2**40),
    st.randoms(use_true_random=False),
)
def test_every_frame_is_decoded_as_it_was_encoded(count, channels, time_us, index, random):
    codes = np.array(
        [[random.randrange(2**16) for _ in range(channels)] for _ in range(count)], np.uint16
    )
    raw = Encoder(replace(INFO, channels=channels)).sample_frame(time_us, index, codes)
    assert raw.count(b'\0') == 1
    assert raw.endswith(b'\0')
    data = decode(raw[:-1])
    assert np.array_equal(data.codes, codes)
    assert (data.time_us, data.index) == (time_us, index % 2**32)
