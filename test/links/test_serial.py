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

"""The serial link on real terminals, without ROS: what it makes of frames, and of what is none."""

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
from adxl_ros.links.support.wire_format import BoardInfo, encode_payload, Encoder
import numpy as np
import pytest
from units import nominal

INFO = BoardInfo(1000.0, 16, 2, 5.0, 'A7')


class Line:
    """A terminal pair, the board's end written by hand, and a link that reads the other."""

    def __init__(self, tmp_path, info=INFO, sensor=None, **settings):
        self.path = tmp_path / 'port'
        self.info, self.codes = info, np.arange(info.channels * 10).reshape(10, -1) + 30000
        self.index = 0
        self.plug()
        self.link = serial.open_link(sensor or nominal(),
                                     serial.Settings(port=str(self.path), **settings))
        self.link.begin(0)
        self.encoder = Encoder(info)
        self.samples = []
        self.link.read(0)

    def plug(self):
        self.ours, self.theirs = pty.openpty()
        tty.setraw(self.theirs)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self.theirs))

    def unplug(self):
        # Its name first: a terminal's number may soon be another's.
        self.path.unlink(missing_ok=True)
        os.close(self.ours)
        os.close(self.theirs)

    def send(self, raw):
        os.write(self.ours, raw)

    def inform(self):
        self.send(self.encoder.info_frame())

    def frames(self, count=1, pace_s=0.0):
        for _ in range(count):
            self.send(self.encoder.sample_frame(self.index * 1000, self.index, self.codes))
            self.index += len(self.codes)
            time.sleep(pace_s)

    def read(self, until=None, timeout_s=5.0):
        """Read until a condition holds, or for 0.2 s; returns all samples of that."""
        end = time.monotonic() + (timeout_s if until else 0.2)
        got = []
        while time.monotonic() < end and not (until and until(got)):
            samples = self.link.read(0)
            if len(samples.stamp_ns):
                got.append(samples)
        self.samples += got
        return got

    def number(self, got):
        return sum(len(samples.stamp_ns) for samples in got)

    def value(self, name):
        return self.link.status().values()[name]

    def close(self):
        self.link.close()
        self.unplug()


@pytest.fixture
def line(tmp_path):
    lines = []

    def make(**options):
        lines.append(Line(tmp_path, **options))
        return lines[-1]
    yield make
    for one in lines:
        one.close()


def test_samples_are_volts_of_the_codes_at_the_rate_of_the_board(line):
    one = line(info=BoardInfo(500.0, 12, 2, 3.3, 'B9'))
    one.codes %= 4096
    one.inform()
    one.frames(5)
    got = one.read(lambda g: one.number(g) >= 50)
    volts = np.concatenate([s.volts for s in got])
    assert volts[:10] == pytest.approx(one.codes * np.float32(3.3) / 4096, rel=1e-7)
    assert (one.link.sensor.serial, one.link.sensor.rate_hz, one.link.sensor.adc_bits) == (
        'B9', 500.0, 12)
    assert one.link.sensor.adc_vref_v == pytest.approx(3.3)
    assert one.link.status().level == base.Level.OK
    assert one.link.status().text == 'streaming'
    assert sum(s.missing for s in got) == 0


def test_data_before_the_first_info_is_held_back_and_counted(line):
    one = line()
    one.frames(7)
    assert not one.read()
    assert one.value('held_back') == 70
    one.inform()
    one.frames(3)
    got = one.read(lambda g: one.number(g) >= 30)
    assert one.number(got) == 30
    assert one.value('held_back') == 70
    assert sum(s.missing for s in got) == 0


def test_a_frame_that_was_lost_is_missing_exactly(line):
    one = line()
    one.inform()
    one.frames(3)
    one.index += 4321
    one.frames(3)
    got = one.read(lambda g: one.number(g) >= 60)
    assert sum(s.missing for s in got) == 4321
    assert sum(s.estimated for s in got) == 0
    stamps = np.concatenate([s.stamp_ns for s in got])
    assert (np.diff(stamps) > 0).all()
    assert np.diff(stamps)[29] == pytest.approx(4.322e9, rel=0.06), 'the gap shows in the stamps'


def test_a_repeated_frame_is_not_published_again(line):
    one = line()
    one.inform()
    raw = one.encoder.sample_frame(0, 0, one.codes)
    one.send(raw + raw)
    one.index = 10
    one.frames(2)
    one.send(raw)
    one.frames(1)
    got = one.read(lambda g: one.number(g) >= 40)
    assert one.number(got) == 40
    assert one.value('repeated') == 20


def test_a_reset_is_told_apart_from_a_loss_and_estimated(line):
    one = line()
    one.inform()
    one.frames(20, 0.01)
    before = one.read(lambda g: one.number(g) >= 200)
    time.sleep(0.5)
    one.encoder, one.index = Encoder(one.info), 0
    one.inform()
    one.frames(20, 0.01)
    after = one.read(lambda g: one.number(g) >= 200)
    assert one.value('resets') == 1
    lost = sum(s.missing for s in after)
    assert lost == sum(s.estimated for s in after)
    gap_s = (after[0].stamp_ns[0] - before[-1].stamp_ns[-1]) * 1e-9
    assert lost == pytest.approx(gap_s * 1000 - 1, abs=1)
    assert 450 < lost < 900


def test_another_board_on_the_port_is_another_sensor(line):
    one = line()
    one.inform()
    one.frames(3)
    one.read(lambda g: one.number(g) >= 30)
    one.encoder, one.index = Encoder(BoardInfo(1000.0, 12, 2, 2.5, 'Z1')), 0
    one.codes = np.full((10, 2), 2048)
    one.inform()
    one.frames(3)
    got = one.read(lambda g: one.number(g) >= 30)
    assert one.link.sensor.serial == 'Z1'
    assert np.concatenate([s.volts for s in got]) == pytest.approx(1.25)


@pytest.mark.parametrize('listed', ['x,y,supply,temperature', ['y', '-', 'x', 'supply']])
def test_channels_are_what_the_parameter_says(line, listed):
    one = line(info=BoardInfo(1000.0, 16, 4, 5.0, ''), channels=listed, supply_scale=2.0)
    one.codes = np.tile(np.array([20000, 30000, 32000, 40000]), (10, 1))
    one.inform()
    one.frames(40, 0.005)
    got = one.read(lambda g: one.number(g) >= 400)
    volts = dict(zip(listed.split(',') if isinstance(listed, str) else listed,
                     one.codes[0] * 5 / 2 ** 16))
    assert np.concatenate([s.volts for s in got])[0] == pytest.approx([volts['x'], volts['y']])
    supply = np.concatenate([s.references['supply_v'] for s in got])
    assert supply[np.isfinite(supply)] == pytest.approx(2 * volts['supply'])
    assert 2 <= np.isfinite(supply).sum() <= 5, 'ten a second'
    if 'temperature' in volts:
        told = np.concatenate([s.references['temperature_c'] for s in got])
        assert told[np.isfinite(told)] == pytest.approx((volts['temperature'] - 0.5) / 0.01)
    assert one.link.sensor.serial == nominal().serial, 'a board without a serial number'


def test_by_default_the_channels_are_x_y_z_supply(line):
    one = line(info=BoardInfo(1000.0, 16, 4, 5.0, ''), sensor=nominal('xyz'))
    one.inform()
    one.frames(30, 0.005)
    got = one.read(lambda g: one.number(g) >= 300)
    assert got[0].volts.shape[1] == 3
    supply = np.concatenate([s.references['supply_v'] for s in got])
    assert supply[np.isfinite(supply)] == pytest.approx(
        one.codes[:, 3].mean() * 5 / 2 ** 16, rel=1e-3)


@pytest.mark.parametrize('info, options, why', [
    (BoardInfo(1000.0, 16, 1, 5.0, ''), {}, 'no channel for y'),
    (INFO, {'channels': 'x,y,supply'}, '3 are named, the board has 2')])
def test_a_board_that_does_not_fit_publishes_nothing_and_says_why(line, info, options, why):
    one = line(info=info, **options)
    one.inform()
    one.frames(5)
    assert not one.read()
    state = one.link.status()
    assert state.level == base.Level.ERROR
    assert why in state.text
    assert one.value('held_back') == 50


def test_a_channel_that_the_sensor_does_not_have_is_not_published(line):
    one = line(info=BoardInfo(1000.0, 16, 3, 5.0, ''))
    one.inform()
    one.frames(5)
    got = one.read(lambda g: one.number(g) >= 50)
    assert got[0].volts.shape[1] == 2
    assert 'the channel of z is not used' in one.link.status().text


def test_frames_that_the_info_frame_rules_out_are_not_published(line):
    one = line(info=BoardInfo(1000.0, 12, 2, 5.0, ''))
    one.codes %= 4096
    one.inform()
    one.frames(2)
    one.codes[3, 1] = 4096
    one.frames(1)
    one.codes = np.full((10, 3), 1000)
    one.frames(1)
    one.codes = np.full((10, 2), 1000)
    one.frames(1)
    got = one.read(lambda g: one.number(g) >= 30)
    assert one.number(got) == 30
    assert sum(s.missing for s in got) == 20
    assert one.value('bad_frames') == 2


def test_another_version_of_the_format_is_said(line):
    one = line()
    one.send(encode_payload(b'\1\2' + bytes(30)))
    assert not one.read()
    assert 'speaks wire format 2' in one.link.status().text
    one.inform()
    one.frames(3)
    one.read(lambda g: one.number(g) >= 30)
    assert one.link.status().text == 'streaming'


def test_nothing_and_nonsense_are_told_apart(line):
    one = line()
    one.inform()
    one.frames(3)
    one.read()
    time.sleep(0.6)
    one.read()
    assert 'silent' in one.link.status().text
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        one.send(os.urandom(50).replace(b'\0', b'\1') + b'\0')
        one.link.read(0)
    assert 'is link.baud (115200) that of the board?' in one.link.status().text
    one.frames(3)
    one.read(lambda g: one.number(g) >= 30)
    assert one.link.status().text == 'streaming'


def test_frames_faster_than_a_board_can_mean_wait(line):
    one = line()
    one.inform()
    stop = time.monotonic() + 2.0

    def flood():
        while time.monotonic() < stop:
            one.frames(10)
    writer = threading.Thread(target=flood)
    writer.start()
    got = one.read(lambda g: time.monotonic() > stop)
    while writer.is_alive():
        got += one.read()
    assert one.number(got) < 2.5 * 20 * 1000 + 6000, 'twenty times the rate, and what is credited'
    writer.join()
    stamps = np.concatenate([s.stamp_ns for s in got])
    assert (np.diff(stamps) > 0).all()


def test_a_port_comes_back_and_the_count_goes_on(line):
    one = line()
    one.inform()
    one.frames(20, 0.01)
    one.read(lambda g: one.number(g) >= 200)
    one.unplug()
    went = time.monotonic()
    one.read(lambda g: one.link.status().level == base.Level.ERROR)
    assert one.link.status().level == base.Level.ERROR
    time.sleep(0.3)
    one.plug()
    back = time.monotonic()
    one.index += round((time.monotonic() - went) * 1000)
    lost = one.index - 200
    got = []
    while one.number(got) < 100:
        one.frames(1, 0.01)
        got += one.read(lambda g: one.number(g) >= 10, 0.02)
        assert time.monotonic() < back + 5
    assert one.value('connections') == 2
    assert one.value('resets') == 0
    said = sum(s.missing for s in got)
    assert said >= lost
    assert (said - lost) % 10 == 0, 'frames sent before the port was open again are missing, too'
    assert sum(s.estimated for s in got) == 0


def test_a_socket_is_a_port_too():
    with socket.create_server(('127.0.0.1', 0)) as server:
        link = serial.open_link(nominal(), serial.Settings(
            port=f'socket://127.0.0.1:{server.getsockname()[1]}'))
        accepted = []
        thread = threading.Thread(target=lambda: accepted.append(server.accept()[0]))
        thread.start()
        link.read(0)
        thread.join()
        encoder, codes, count = Encoder(INFO), np.full((10, 2), 1000), 0
        accepted[0].sendall(encoder.info_frame())
        began = time.monotonic()
        for k in range(300):
            accepted[0].sendall(encoder.sample_frame(10_000 * k, 10 * k, codes))
        while count < 3000 and time.monotonic() < began + 5:
            count += len(link.read(0).stamp_ns)
        assert count == 3000
        accepted[0].close()
        link.read(0)
        assert 'unplugged' in link.status().text
        link.close()


@pytest.mark.parametrize('options, why', [
    ({'port': ''}, 'link.port: names no port'), ({'channels': 'x,w'}, "'w'"),
    ({'channels': 'x'}, 'no channel for y'), ({'temperature_v_per_c': 0.0}, 'temperature_v_per')])
def test_options_that_cannot_be_are_refused(options, why):
    with pytest.raises(UserError, match=why):
        serial.open_link(nominal(), serial.Settings(**{'port': '/dev/null', **options}))


@pytest.mark.parametrize('port, why', [
    ('/no/such/port', 'No such file'), ('gopher://x', 'gopher|URL|protocol'),
    ('socket://127.0.0.1:1', 'refused'), ('/etc/hostname', 'configure|ioctl|Inappropriate')])
def test_a_port_that_does_not_open_says_why(port, why):
    link = serial.open_link(nominal(), serial.Settings(port=port))
    link.read(0)
    state = link.status()
    assert state.level == base.Level.ERROR
    assert port in state.text
    assert '\n' not in state.text
    assert re.search(why, state.text), state.text
    link.close()


def test_a_board_on_a_terminal_is_read_to_the_last_sample(tmp_path):
    path, sensor = str(tmp_path / 'board'), nominal(serial='S5')
    rng = np.random.default_rng(0)
    columns = {'x_v': rng.uniform(1, 4, 1000), 'y_v': rng.uniform(1, 4, 1000),
               'supply_v': np.full(1000, 4.9)}
    with emulated_board.open_terminal(path) as fd:
        sender = emulated_board.Board(sensor, emulated_board.roles_of(sensor, columns), fd)
        link = serial.open_link(sensor, serial.Settings(port=path, supply_scale=2.0,
                                                        channels='x,y,supply'))
        link.read(0)
        thread = threading.Thread(target=sender.send, args=(columns,))
        thread.start()
        got, end = [], time.monotonic() + 10
        while sum(map(len, got)) < 1000 and time.monotonic() < end:
            got.append(link.read(0).volts)
        thread.join()
        volts = np.concatenate(got)
        assert volts.shape == (1000, 2)
        assert np.abs(volts - np.column_stack([columns['x_v'], columns['y_v']])).max() <= \
            sensor.lsb_v
        assert link.sensor.serial == 'S5'
        link.close()
    assert not os.path.lexists(path)
