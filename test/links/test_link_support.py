# SPDX-License-Identifier: Apache-2.0

"""The parts of links without ROS: clock map, frame counter, channels."""

from dataclasses import replace

from adxl_ros.errors import UserError
from adxl_ros.links.support import base, channels, clock_sync, emulated_board
from adxl_ros.links.support.clock_sync import ClockMap, SystemClockMap
from adxl_ros.links.support.frame_counter import FrameCounter
from adxl_ros.links.support.wire_format import AFTER_RESET, SampleFrame
from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from units import nominal

MS, S = 1_000_000, 1_000_000_000
START = 5_000 * S


class DelayedFrames:
    """Frames of ten samples at 1 kHz by a device's clock, with the delay of a link."""

    def __init__(self, ppm=0.0, min_ms=0.1, max_ms=5.0, delay_s=0.0, seed=0):
        self.map = ClockMap(delay_s)
        self.scale = 1 + ppm * 1e-6
        self.min_ns, self.max_ns = min_ms * MS, max_ms * MS
        self.rng = np.random.default_rng(seed)
        self.origin, self.count = 0, 0
        self.held, self.stamps, self.truth = [], [], []
        self.arrived = 0

    def run(self, frames, late_ms=0.0, device_ms=0.0, truth_ms=0.0):
        """Send frames with an extra delay, after a step of device time or of true time, ms."""
        self.origin += truth_ms * MS
        for _ in range(frames):
            number = self.count + np.arange(10)
            self.count += 10
            device = (number * MS + S + device_ms * MS).astype(np.int64)
            true = START + self.origin + number * MS * self.scale
            late = self.rng.uniform(self.min_ns, self.max_ns) + late_ms * MS
            self.arrived = max(int(true[-1] + late), self.arrived)
            self.map.observe(int(device[-1]), self.arrived)
            self.held.append((device, true))
            self.stamp()

    def stamp(self):
        """Stamp the frames that wait, when the map is ready."""
        if self.map.ready(self.arrived):
            for device, true in self.held:
                self.stamps.append(self.map.host_ns(device))
                self.truth.append(true)
            self.held = []

    def errors(self):
        """Check the order of the stamps and return their errors, ms."""
        stamps = np.concatenate(self.stamps)
        assert (np.diff(stamps) > 0).all(), 'stamps never go backwards'
        return (stamps - np.concatenate(self.truth)) / MS


@pytest.mark.parametrize('ppm, min_ms, max_ms, delay_s', [
    (100, 0.0, 5.0, 0), (-100, 0.2, 5.2, 0), (100, 3.0, 8.0, 0.003), (0, 0.1, 5.1, 0)])
def test_stamps_of_a_jittery_link_are_true_to_a_millisecond(ppm, min_ms, max_ms, delay_s):
    frames = DelayedFrames(ppm, min_ms, max_ms, delay_s, seed=ppm % 7)
    frames.run(4000)
    errors = frames.errors()
    assert np.abs(errors).max() < 1.0, 'from the first sample on'
    assert np.abs(errors[5000:]).max() < 0.4
    assert frames.map.drift_ppm == pytest.approx(ppm, abs=10)


def test_stamps_of_a_steady_link_have_no_jitter():
    frames = DelayedFrames(80, 0.05, 0.15)
    frames.run(4000)
    stamps = np.concatenate(frames.stamps)[5000:]
    x = np.arange(len(stamps))
    line = np.polyval(np.polyfit(x, stamps - stamps[0], 1), x)
    assert (stamps - stamps[0] - line).std() < 20_000
    assert np.diff(stamps).std() < 1000
    assert frames.map.steps == 0


def test_late_frames_do_not_disturb_the_map():
    frames = DelayedFrames(-60, 0.05, 0.1)
    frames.run(2000)
    frames.run(20, late_ms=180)
    frames.run(500)
    frames.run(3, late_ms=5000)
    frames.run(1500)
    assert np.abs(frames.errors()[1000:]).max() < 0.5
    assert frames.map.steps == 0


@pytest.mark.parametrize('step_ms', [400, -400, 30, -60, 3_600_000])
def test_a_step_of_the_device_clock_is_recognised(step_ms):
    frames = DelayedFrames(50, 0.05, 0.5)
    frames.run(1500)
    frames.run(1500, device_ms=step_ms)
    errors = frames.errors()
    assert frames.map.steps == 1
    assert np.abs(errors[:15000]).max() < 1
    assert np.abs(errors[15000 + 3000:]).max() < 1.0, 'from three seconds after the step on'


def test_a_clock_that_stood_still_is_a_step_and_a_gap():
    frames = DelayedFrames(50, 0.05, 0.5)
    frames.run(1500)
    frames.run(1500, truth_ms=3000)
    errors = frames.errors()
    assert frames.map.steps == 1
    assert np.abs(errors).max() < 1.5, 'no stamp lies in the time for which the clock stood still'


def test_samples_that_were_read_late_are_no_step_forward():
    """At the pace of time they look like a clock that stopped, until the next are in time."""
    frames = DelayedFrames(50, 0.05, 0.5)
    frames.run(1500)
    frames.run(30, late_ms=2000)
    assert frames.map.steps == 1
    frames.count += 2000
    frames.run(500)
    assert frames.map.steps == 1, 'the device stamps show the loss of two seconds'
    assert np.abs(frames.errors()[-1000:]).max() < 1


def test_ros_time_follows_the_system_clock_when_it_is_set(monkeypatch):
    now = {'monotonic': 10 * S, 'time': 1000 * S}
    monkeypatch.setattr(clock_sync.time, 'monotonic_ns', lambda: now['monotonic'])
    monkeypatch.setattr(clock_sync.time, 'time_ns', lambda: now['time'])
    clock = SystemClockMap()
    assert clock.ros_ns(np.array([11 * S])) == [1001 * S]
    for name in now:
        now[name] += 5 * S
    assert clock.update() == 0
    now['time'] -= 3600 * S
    assert clock.update() == -3600 * S
    assert clock.steps == 1
    assert clock.ros_ns(np.array([11 * S])) == [1001 * S - 3600 * S]


def data(index, time_us=None, flags=0, overruns=0, seed=0, count=10):
    """Return a frame, by default at its time at 1 kHz."""
    time_us = index * 1000 if time_us is None else time_us
    check = hash((index, time_us, flags, seed))
    return SampleFrame(flags, 0, time_us, index % 2 ** 32, overruns, np.zeros((count, 2)), check)


def counted(*frames, arrived_us=None):
    """Return a counter that has taken frames, and (index, lost, stepped) of the accepted ones."""
    counter = FrameCounter()
    counter.restart(1000.0)
    accepted = []
    for frame in frames:
        arrival_us = frame.time_us if arrived_us is None else arrived_us(frame)
        accepted += counter.accept(frame, arrival_us * 1000)
    return counter, [(part.frame.index, part.lost, part.stepped) for part in accepted]


def test_missing_samples_are_counted_across_the_wrap():
    base = 2 ** 32 - 15
    _, accepted = counted(*(data(base + k, time_us=k * 1000) for k in (0, 10, 20, 50)))
    assert accepted == [(base, None, False), (base + 10, 0, False), (5, 0, False), (35, 20, False)]


def test_repeated_and_late_frames_are_not_accepted():
    counter, accepted = counted(data(0), data(10), data(10), data(0), data(20), data(50), data(30),
                                data(60))
    assert [i for i, *_ in accepted] == [0, 10, 20, 50, 60]
    assert [lost for _, lost, _ in accepted] == [None, 0, 0, 20, 0]
    assert counter.repeated == 30


def test_a_reset_begins_a_new_count_with_and_without_its_flag():
    _, accepted = counted(data(500), data(510), data(0, 100, AFTER_RESET), data(10, 10100))
    assert accepted == [(500, None, False), (510, 0, False), (0, None, False), (10, 0, False)]
    _, accepted = counted(data(500), data(510), data(30, 30100), data(50, 50100), data(60, 60100))
    assert accepted == [(500, None, False), (510, 0, False), (30, None, False), (50, 10, False),
                        (60, 0, False)]


def test_a_board_that_repeats_itself_after_its_reset_is_accepted_again():
    first = [data(10 * k) for k in range(300)]
    arrivals = iter(range(0, 10 ** 9, 10_000))
    _, accepted = counted(*first, *first, arrived_us=lambda f: next(arrivals))
    again = [lost for _, lost, _ in accepted].index(None, 1)
    assert again == 300
    assert 2900 <= len(accepted) * 10 - 2500 <= 3000, 'the decision takes half a second'


def test_a_step_of_the_clock_without_a_loss_is_reported():
    _, accepted = counted(data(0), data(10), data(20, 5_020_000), data(30, 5_030_000))
    assert accepted == [(0, None, False), (10, 0, False), (20, 0, True), (30, 0, False)]


@pytest.mark.parametrize('index, away_s, lost', [
    (1010, 1.0, 1000), (10, 0.05, 0), (10, 9.0, 0), (1010, 3.0, None), (0, 1.0, None)])
def test_a_count_continues_across_a_closed_port_if_the_clocks_agree(index, away_s, lost):
    counter = FrameCounter()
    counter.restart(1000.0)
    counter.accept(data(0), 0)
    counter.reopened()
    counter.reopened()
    accepted = counter.accept(data(index, seed=1), round(away_s * 1e9) + 10 * MS)
    assert [f.lost for f in accepted] == [lost]


def test_overruns_of_the_device_are_counted_across_the_wrap():
    counter, _ = counted(data(0, overruns=65530), data(20, overruns=4), data(30, overruns=4),
                         data(0, 50, AFTER_RESET, overruns=0), data(20, 20050, overruns=10))
    assert counter.overruns == 10 + 10


@settings(max_examples=200)
@given(st.lists(st.integers(0, 60), max_size=60))
def test_no_frame_is_accepted_twice_or_out_of_order(order):
    _, accepted = counted(*(data(10 * k) for k in order), arrived_us=lambda f: 0)
    run = []
    for index, lost, _ in accepted:
        run = run + [index] if lost is not None else [index]
        assert run == sorted(set(run))
    assert len(accepted) <= len(order)


def test_channels_are_a_list_or_a_string():
    roles = ['x', 'y', 'supply']
    assert channels.parse_channels('x, y,supply') == channels.parse_channels(roles) == roles
    assert channels.parse_channels('') == channels.parse_channels(()) == []


@pytest.mark.parametrize('roles, reason', [
    ('x', 'no channel for y'), ('x,y,x', 'twice'), ('x,y,z', 'no axis z'), ('x,y,w', "'w' is")])
def test_channels_that_do_not_fit_the_sensor_are_refused(roles, reason):
    with pytest.raises(UserError, match=reason):
        channels.check_roles(channels.parse_channels(roles), 'xy')


def test_slow_values_are_means_of_a_tenth_of_a_second():
    means = channels.PeriodMeans()
    stamps = np.arange(1000) * MS
    values = np.arange(1000.0)
    out = np.concatenate([means.thin(stamps[k:k + 10], {'supply_v': values[k:k + 10]})['supply_v']
                          for k in range(0, 1000, 10)])
    rows = np.flatnonzero(np.isfinite(out))
    assert rows.tolist() == list(range(100, 1000, 100))
    assert out[rows] == pytest.approx([row - 50.5 for row in rows])


@pytest.mark.parametrize('change, reason', [
    ({'adc_bits': 0}, 'adc_bits'), ({'adc_bits': 24}, '24'), ({'serial': 'x' * 17}, 'serial')])
def test_a_sensor_beyond_the_wire_format_is_refused(change, reason):
    with pytest.raises(UserError, match=reason):
        emulated_board.check_sensor(replace(nominal(), **change))


def test_samples_that_are_not_finite_are_missing():
    samples = base.Samples(np.arange(3), np.array([[1.0, 2.0], [np.nan, 2.0], [1.0, np.inf]]), 3,
                           missing=4, estimated=1, imu_fields={'orientation': np.eye(3)})
    finite = samples.finite()
    assert finite.stamp_ns.tolist() == [0] and finite.volts.tolist() == [[1.0, 2.0]]
    assert (finite.missing, finite.estimated, finite.until_ns) == (6, 1, 3)
    assert finite.imu_fields['orientation'].tolist() == [[1.0, 0.0, 0.0]]
    assert finite.finite() is finite
