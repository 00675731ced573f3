# SPDX-License-Identifier: Apache-2.0

"""The self-test: how its step is judged, and that no sample that it changes is published."""

import threading

from adxl_ros.errors import UserError
from adxl_ros.links import serial, sim, topic
from adxl_ros.links.support import emulated_board
from adxl_ros.links.support.self_test import HOLD_S, judge, SelfTest
import numpy as np
import pytest
from units import nominal

LIMITS = {'self_test_lower_g': (0.45, 0.45), 'self_test_upper_g': (1.05, 1.05)}
MS = 1_000_000
START = 1_700_000_000 * 10**9


def means(x_g, y_g=0.0, shake_g=0.0):
    """Return the means of four blocks at forces of the axes, g; x moves from block to block."""
    volts = 2.5 + np.array([[x_g, y_g]] * 4)
    volts[::2, 0] += shake_g
    return volts


@pytest.mark.parametrize(
    ('on', 'limits', 'begin', 'words'),
    [
        (means(0.74, 0.76), LIMITS, 'PASS x +0.74 g (0.45 to 1.05), y +0.76 g', '1.05)'),
        (means(0.74, 0.21), LIMITS, 'FAIL y: x +0.74 g', 'y +0.21 g (0.45 to 1.05)'),
        (means(0.0, 0.0), LIMITS, 'FAIL x, y: x +0.00 g', 'no step: is the self-test pin'),
        (
            means(0.5, 0.7, 0.4),
            LIMITS,
            'NOT SURE x +0.70 g',
            'by 0.40 g, y +0.70 g (0.45 to 1.05); keep x level',
        ),
        (means(1.8, 0.7), LIMITS, 'NOT SURE x', 'at the end of its range, y +0.70 g'),
        (means(0.74, 0.7), {}, 'NOT COMPARED x +0.74 g, y +0.70 g;', 'self_test_lower_g'),
    ],
    ids=['pass', 'weak', 'unconnected', 'moved', 'range', 'no-limits'],
)
def test_the_step_of_each_axis_is_compared(on, limits, begin, words):
    answer = judge(nominal(**limits), means(0.0), on)
    assert answer.text.startswith(begin) and words in answer.text and '\n' not in answer.text
    assert answer.is_passed == begin.startswith('PASS')


def run(link, sensor, read):
    """Run a self-test; return the samples that were read and published, V, and the answer."""
    test, before, read_v, published_v = SelfTest(link.hold_self_test), 100, [], []
    while (answer := None if before > 0 else test.begin()) is None:
        samples = read()
        published, answer = test.take(samples, link.sensor or sensor)
        before -= len(samples.volts)
        read_v.append(samples.volts)
        published_v.append(published.volts)
        if answer is not None:
            break
    return np.concatenate(read_v), np.concatenate(published_v), answer


def test_the_simulated_sensor_has_it_and_no_step_is_published():
    sensor, now_ns = nominal(**LIMITS), START
    link = sim.open_link(sensor, sim.Settings())
    link.begin(START)

    def read():
        nonlocal now_ns
        now_ns += 4 * MS
        return link.read(now_ns)

    read_v, published_v, answer = run(link, sensor, read)
    assert answer.text.startswith('PASS x +0.75 g')
    assert (read_v.max(axis=0) > 3.2).all(), 'the step'
    assert np.abs(published_v - 2.5).max() < 6e-3, 'the noise'
    assert 500 < len(read_v) - len(published_v) < 1200
    # Without its driver it ends by itself.
    link.hold_self_test(HOLD_S)
    marks = np.concatenate([read().in_self_test for _ in range(250)])
    assert marks[:690].all() and not marks[715:].any()


@pytest.mark.parametrize('has_step', [True, False])
def test_the_emulated_board_has_it(tmp_path, has_step):
    sensor = nominal(**(LIMITS if has_step else {'self_test_g': ()}))
    columns = {'x_v': np.full(500, 2.4), 'y_v': np.full(500, 2.6)}
    stop = threading.Event()
    with emulated_board.open_terminal(str(tmp_path / 'board')) as fd:
        board = emulated_board.Board(sensor, ['x', 'y'], fd)

        def send():
            while not stop.is_set():
                board.send(columns)

        link = serial.open_link(sensor, serial.Settings(port=str(tmp_path / 'board')))
        with pytest.raises(UserError, match='no board that has a self-test'):
            link.hold_self_test(0.0)
        link.read(0)
        thread = threading.Thread(target=send)
        thread.start()
        try:
            read_v, published_v, answer = run(link, sensor, lambda: link.read(0))
        finally:
            stop.set()
            thread.join()
            link.close()
    assert np.abs(published_v - [2.4, 2.6]).max() <= sensor.lsb_v
    if has_step:
        assert answer.text.startswith('PASS x +0.75 g') and (read_v.max(axis=0) > 3.1).all()
    else:
        assert 'no board that has a self-test line' in answer.text and '\n' not in answer.text


def test_other_links_say_that_they_have_none():
    link = topic.open_link(nominal('xyz'), topic.Settings())
    answer = SelfTest(link.hold_self_test).begin()
    assert answer.text.startswith('this link reaches no self-test') and '\n' not in answer.text
