# SPDX-License-Identifier: Apache-2.0

"""The serial link on real terminals, without ROS: frames, faults, settings."""

import os
import pty
import re
import socket
import threading
import time
import tty

from adxl_ros.errors import UserError
from adxl_ros.links import serial
from adxl_ros.links.support import base, emulated_board
from adxl_ros.links.support.wire_format import (
    BoardInfo,
    decode_command,
    encode_payload,
    Encoder,
    Splitter,
)
import numpy as np
import pytest
from units import nominal

INFO = BoardInfo(1000.0, 16, 2, 5.0, 'A7')


class ConnectedBoard:
    """A board, one end of a terminal: `codes` of the next frame, `index` of its first sample."""

    def __init__(self, tmp_path, info=INFO, sensor=None, **settings):
        self.path = tmp_path / 'port'
        self.info, self.codes = info, np.arange(info.channels * 10).reshape(10, -1) + 30000
        self.index = 0
        self.plug()
        self.link = serial.open_link(
            sensor or nominal(), serial.Settings(port=str(self.path), **settings)
        )
        self.link.begin(0)
        self.encoder = Encoder(info)
        self.link.read(0)

    def plug(self):
        self.board_fd, self.driver_fd = pty.openpty()
        tty.setraw(self.driver_fd)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self.driver_fd))

    def unplug(self):
        """Remove the name first: another terminal may soon have the same number."""
        self.path.unlink(missing_ok=True)
        os.close(self.board_fd)
        os.close(self.driver_fd)

    def send(self, raw):
        os.write(self.board_fd, raw)

    def send_info(self):
        self.send(self.encoder.info_frame())

    def send_frames(self, count=1, pause_s=0.0):
        for _ in range(count):
            self.send(self.encoder.sample_frame(self.index * 1000, self.index, self.codes))
            self.index += len(self.codes)
            time.sleep(pause_s)

    def read(self, timeout_s=0.2, until=lambda parts: False):
        end_s = time.monotonic() + timeout_s
        parts = []
        while time.monotonic() < end_s and not until(parts):
            samples = self.link.read(0)
            if len(samples.stamp_ns):
                parts.append(samples)
        return parts

    def read_samples(self, count, timeout_s=60.0):
        return self.read(timeout_s, lambda parts: sample_count(parts) >= count)

    def wait_for(self, text, send=lambda: None, timeout_s=60.0):
        end_s = time.monotonic() + timeout_s
        while text not in self.link.status().text:
            assert time.monotonic() < end_s, self.link.status().text
            send()
            self.link.read(0)

    def commands(self):
        os.set_blocking(self.board_fd, False)
        try:
            received = os.read(self.board_fd, 4096)
        except BlockingIOError:
            return []
        return [decode_command(raw).time_us for raw in Splitter().split(received)]

    def value(self, name):
        return self.link.status().statistics[name]

    def close(self):
        self.link.close()
        self.unplug()


def sample_count(parts):
    return sum(len(part.stamp_ns) for part in parts)


def missing(parts):
    return sum(part.missing for part in parts)


def estimated(parts):
    return sum(part.estimated for part in parts)


def volts_of(parts):
    return np.concatenate([part.volts for part in parts])


def stamps_of(parts):
    return np.concatenate([part.stamp_ns for part in parts])


def reference(name, parts):
    values = np.concatenate([part.references[name] for part in parts])
    return values[np.isfinite(values)]


@pytest.fixture
def connect(tmp_path):
    boards = []

    def make(**settings):
        boards.append(ConnectedBoard(tmp_path, **settings))
        return boards[-1]

    yield make
    for board in boards:
        board.close()


def test_samples_are_volts_of_the_codes_at_the_rate_of_the_board(connect):
    board = connect(info=BoardInfo(500.0, 12, 2, 3.3, 'B9'))
    board.codes %= 4096
    board.send_info()
    board.send_frames(5)
    parts = board.read_samples(50)
    volts = volts_of(parts)
    assert volts[:10] == pytest.approx(board.codes * np.float32(3.3) / 4096, rel=1e-7)
    assert (board.link.sensor.serial, board.link.sensor.rate_hz, board.link.sensor.adc_bits) == (
        'B9',
        500.0,
        12,
    )
    assert board.link.sensor.adc_vref_v == pytest.approx(3.3)
    board.wait_for('streaming', board.send_frames)
    assert board.link.status().text == 'streaming'
    assert missing(parts) == 0


def test_a_frame_that_was_lost_is_missing_exactly(connect):
    board = connect()
    board.send_info()
    board.send_frames(3)
    board.index += 4321
    board.send_frames(3)
    parts = board.read_samples(60)
    assert missing(parts) == 4321
    assert estimated(parts) == 0
    stamps = stamps_of(parts)
    assert (np.diff(stamps) > 0).all()
    assert np.diff(stamps)[29] == pytest.approx(4.322e9, rel=0.06), 'the gap shows in the stamps'


def test_the_loss_of_a_reset_is_estimated(connect):
    board = connect()
    board.send_info()
    began_s = time.monotonic()
    board.send_frames(20, 0.01)
    before = board.read_samples(200)
    time.sleep(0.5)
    board.encoder, board.index = Encoder(board.info), 0
    board.send_info()
    board.send_frames(20, 0.01)
    after = board.read_samples(200)
    assert board.value('resets') == 1
    lost = missing(after)
    assert lost == estimated(after)
    gap_s = (after[0].stamp_ns[0] - before[-1].stamp_ns[-1]) * 1e-9
    assert lost == pytest.approx(gap_s * 1000 - 1, abs=1)
    assert 450 < lost < (time.monotonic() - began_s) * 1000


@pytest.mark.parametrize('roles', ['x,y,supply,temperature', ['y', '-', 'x', 'supply']])
def test_channels_are_what_the_parameter_states(connect, roles):
    board = connect(info=BoardInfo(1000.0, 16, 4, 5.0, ''), channels=roles, supply_scale=2.0)
    board.codes = np.tile(np.array([20000, 30000, 32000, 40000]), (10, 1))
    board.send_info()
    board.send_frames(40, 0.005)
    parts = board.read_samples(400)
    volts = dict(
        zip(roles.split(',') if isinstance(roles, str) else roles, board.codes[0] * 5 / 2**16)
    )
    assert volts_of(parts)[0] == pytest.approx([volts['x'], volts['y']])
    supply_v = reference('supply_v', parts)
    assert supply_v == pytest.approx(2 * volts['supply'])
    assert 2 <= len(supply_v) <= 5, 'ten a second'
    if 'temperature' in volts:
        temperature_c = reference('temperature_c', parts)
        assert temperature_c == pytest.approx((volts['temperature'] - 0.5) / 0.01)
    assert board.link.sensor.serial == nominal().serial, 'the board states no serial number'


@pytest.mark.parametrize(
    'info, settings, reason',
    [
        (BoardInfo(1000.0, 16, 1, 5.0, ''), {}, 'the channels are x; expected each of x, y'),
        (INFO, {'channels': 'x,y,supply'}, '3 are named, the board has 2'),
    ],
)
def test_a_board_that_does_not_fit_states_why(connect, info, settings, reason):
    board = connect(info=info, **settings)
    board.send_info()
    board.send_frames(5)
    assert not board.read()
    status = board.link.status()
    assert status.level == base.Level.ERROR
    assert reason in status.text
    assert board.value('held_back') == 50


def test_frames_that_contradict_the_info_frame_are_not_published(connect):
    board = connect(info=BoardInfo(1000.0, 12, 2, 5.0, ''))
    board.codes %= 4096
    board.send_info()
    board.send_frames(2)
    board.codes[3, 1] = 4096
    board.send_frames(1)
    board.codes = np.full((10, 3), 1000)
    board.send_frames(1)
    board.codes = np.full((10, 2), 1000)
    board.send_frames(1)
    parts = board.read_samples(30)
    assert sample_count(parts) == 30
    assert missing(parts) == 20
    assert board.value('bad_frames') == 2


def test_silence_and_bytes_without_a_frame_are_distinguished(connect, monkeypatch):
    monkeypatch.setattr(serial, '_DEAD_S', 0.7)
    board = connect()
    board.send_info()
    board.send_frames(3)
    board.wait_for('silent')
    assert board.link.status().level == base.Level.WARN
    board.wait_for('silent, the board sends nothing; no sample for more than 0.7 s')
    assert board.link.status().level == base.Level.ERROR
    board.wait_for(
        'is link.baud (115200) that of the board',
        lambda: board.send(os.urandom(50).replace(b'\0', b'\1') + b'\0'),
    )
    board.wait_for('streaming', board.send_frames)


def test_a_port_comes_back_and_the_count_goes_on(connect):
    board = connect()
    board.send_info()
    board.send_frames(20, 0.01)
    sent_s = time.monotonic()
    board.read_samples(200)
    board.unplug()
    board.wait_for('No such file')
    time.sleep(0.3)
    board.plug()
    end_s = time.monotonic() + 60
    board.index += round((time.monotonic() - sent_s) * 1000)
    lost = board.index - 200
    parts = []
    while sample_count(parts) < 100:
        board.send_frames(1, 0.01)
        parts += board.read_samples(10, 0.02)
        assert time.monotonic() < end_s
    assert board.value('connections') == 2
    assert board.value('resets') == 0
    assert missing(parts) >= lost
    extra = missing(parts) - lost
    assert extra % 10 == 0, 'frames sent before the port was open again are missing, too'
    assert estimated(parts) == 0


@pytest.mark.parametrize('latency_ms, latency_us', [(2.0, 2000), (5.5, 5500), (0.0, 1000)])
def test_a_board_is_asked_for_small_frames(connect, latency_ms, latency_us):
    board = connect(latency_ms=latency_ms)
    assert board.commands() == [], 'a device that has sent no frame gets no bytes'
    board.send_info()
    board.send_frames(1)
    board.read_samples(10)
    assert board.commands() == [latency_us]
    board.codes = board.codes[: max(int(latency_ms), 1)]
    for count in range(2, 22):
        board.send_frames(1, 0.04)
        # The clock of this board is far too slow, so that its samples would be waited for.
        board.read(5.0, lambda _, count=count: board.value('frames') >= count)
    assert board.commands() == [], 'the board obeys'
    assert board.value('frame_ms') == max(int(latency_ms), 1)


def test_a_socket_is_a_port():
    with socket.create_server(('127.0.0.1', 0)) as server:
        link = serial.open_link(
            nominal(), serial.Settings(port=f'socket://127.0.0.1:{server.getsockname()[1]}')
        )
        accepted = []
        thread = threading.Thread(target=lambda: accepted.append(server.accept()[0]))
        thread.start()
        link.read(0)
        thread.join()
        encoder, codes, count = Encoder(INFO), np.full((10, 2), 1000), 0
        accepted[0].sendall(encoder.info_frame())
        began_s = time.monotonic()
        for k in range(300):
            accepted[0].sendall(encoder.sample_frame(10_000 * k, 10 * k, codes))
        while count < 3000 and time.monotonic() < began_s + 60:
            count += len(link.read(0).stamp_ns)
        assert count == 3000
        accepted[0].close()
        link.read(0)
        assert 'unplugged' in link.status().text
        link.close()


@pytest.mark.parametrize(
    'settings, reason',
    [
        ({'port': ''}, 'link.port: names no port'),
        ({'channels': 'x,w'}, 'channels are x, w; expected'),
        ({'channels': 'x'}, 'expected each of x, y'),
        ({'temperature_v_per_c': 0.0}, 'temperature_v_per'),
    ],
)
def test_settings_that_cannot_work_are_refused(settings, reason):
    with pytest.raises(UserError, match=reason):
        serial.open_link(nominal(), serial.Settings(**{'port': '/dev/null', **settings}))


@pytest.mark.parametrize(
    'port, reason',
    [
        ('/no/such/port', 'No such file'),
        ('gopher://x', 'gopher|URL|protocol'),
        ('socket://127.0.0.1:1', 'refused'),
        ('/etc/hostname', 'configure|ioctl|Inappropriate'),
    ],
)
def test_a_port_that_does_not_open_states_why(port, reason):
    link = serial.open_link(nominal(), serial.Settings(port=port))
    link.read(0)
    status = link.status()
    assert status.level == base.Level.ERROR
    assert port in status.text
    assert '\n' not in status.text
    assert re.search(reason, status.text), status.text
    link.close()


def test_a_board_on_a_terminal_is_read_to_the_last_sample(tmp_path):
    path, sensor = str(tmp_path / 'board'), nominal(serial='S5')
    rng = np.random.default_rng(0)
    columns = {
        'x_v': rng.uniform(1, 4, 1000),
        'y_v': rng.uniform(1, 4, 1000),
        'supply_v': np.full(1000, 4.9),
    }
    with emulated_board.open_terminal(path) as fd:
        sender = emulated_board.Board(sensor, emulated_board.roles_of(sensor, columns), fd)
        link = serial.open_link(
            sensor, serial.Settings(port=path, supply_scale=2.0, channels='x,y,supply')
        )
        link.read(0)
        thread = threading.Thread(target=sender.send, args=(columns,))
        thread.start()
        volts_parts, end_s = [], time.monotonic() + 60
        while sum(map(len, volts_parts)) < 1000 and time.monotonic() < end_s:
            volts_parts.append(link.read(0).volts)
        thread.join()
        volts = np.concatenate(volts_parts)
        assert volts.shape == (1000, 2)
        assert (
            np.abs(volts - np.column_stack([columns['x_v'], columns['y_v']])).max() <= sensor.lsb_v
        )
        assert link.sensor.serial == 'S5'
        assert link.status().statistics['frame_ms'] == 2.0
        link.close()
    assert not os.path.lexists(path)


def test_data_before_the_first_info_is_held_back_and_counted(connect):
    board = connect()
    board.send_frames(7)
    assert not board.read()
    assert board.value('held_back') == 70
    board.send_info()
    board.send_frames(3)
    parts = board.read_samples(30)
    assert sample_count(parts) == 30
    assert board.value('held_back') == 70
    assert missing(parts) == 0


def test_a_repeated_frame_is_not_published_again(connect):
    board = connect()
    board.send_info()
    raw = board.encoder.sample_frame(0, 0, board.codes)
    board.send(raw + raw)
    board.index = 10
    board.send_frames(2)
    board.send(raw)
    board.send_frames(1)
    parts = board.read_samples(40)
    assert sample_count(parts) == 40
    assert board.value('repeated') == 20


def test_another_board_on_the_port_is_another_sensor(connect):
    board = connect()
    board.send_info()
    board.send_frames(3)
    board.read_samples(30)
    board.encoder, board.index = Encoder(BoardInfo(1000.0, 12, 2, 2.5, 'Z1')), 0
    board.codes = np.full((10, 2), 2048)
    board.send_info()
    board.send_frames(3)
    parts = board.read_samples(30)
    assert board.link.sensor.serial == 'Z1'
    assert volts_of(parts) == pytest.approx(1.25)


@pytest.mark.parametrize('stated_hz, samples', [(500.0, 10), (500.0, 2), (2000.0, 10)])
def test_a_rate_that_contradicts_the_clock_is_named_and_no_stamp_is_ahead(
    connect, stated_hz, samples
):
    board = connect(info=BoardInfo(stated_hz, 16, 2, 5.0, ''))
    board.codes = board.codes[:samples]
    board.send_info()
    stamps = []
    for _ in range(500 // samples):
        board.send_frames(1, samples * 1e-3)
        stamps += [part.stamp_ns for part in board.read(0.001)]
        # A busy machine moves the map of the clocks by milliseconds; the stated rate by 500.
        assert not stamps or stamps[-1][-1] <= time.time_ns() + 50_000_000
    steps_ns = np.diff(np.concatenate(stamps))
    assert len(steps_ns) > 200 and (steps_ns > 0).all()
    assert np.median(steps_ns) == pytest.approx(1e6, rel=0.1)
    board.wait_for(f'states {stated_hz:g} Hz, but its clock shows 1000 samples a second')
    assert board.link.status().level == base.Level.ERROR
    assert board.link.sensor.rate_hz == pytest.approx(1000)


def test_a_board_that_was_reset_begins_with_its_stated_rate(connect):
    """A rate that was corrected before the reset is not kept as if it were the stated one."""
    board = connect(info=BoardInfo(500.0, 16, 2, 5.0, ''))
    board.send_info()
    board.wait_for('but its clock shows 1000', board.send_frames)
    board.encoder, board.index = Encoder(board.info), 0
    board.send_info()
    board.wait_for('streaming')
    assert board.link.sensor.rate_hz == 500


def test_a_board_that_waits_for_its_info_is_asked_at_once(connect):
    """It answers with its info frame, so that the first samples need not wait for a second."""
    board = connect()
    board.send_frames(1)
    board.read(0.1)
    assert board.commands() == [2000]


def test_another_version_of_the_format_is_reported(connect):
    board = connect()
    board.send(encode_payload(b'\1\2' + bytes(30)))
    assert not board.read()
    board.wait_for(
        'its firmware of this version?', lambda: board.send(encode_payload(b'\1\2' + bytes(30)))
    )
    board.send_info()
    board.send_frames(3)
    board.read_samples(30)
    assert board.link.status().text == 'streaming'
