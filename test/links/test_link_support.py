# SPDX-License-Identifier: Apache-2.0

"""The parts of links without ROS: clock map, frame counter, channels."""

from dataclasses import replace

from adxl_ros.errors import UserError
from adxl_ros.links.support import emulated_board, stamping
from adxl_ros.links.support.clock_map import ClockMap
from adxl_ros.links.support.clock_rate import ClockRate
from adxl_ros.links.support.wire_format import AFTER_RESET, FrameCounter, SampleFrame
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
        if self.map.advance(self.arrived):
            for device, true in self.held:
                self.stamps.append(self.map.host_ns(device))
                self.truth.append(true)
            self.held = []

    def errors(self):
        """Check the order of the stamps and return their errors, ms."""
        stamps = np.concatenate(self.stamps)
        assert (np.diff(stamps) > 0).all(), 'stamps never go backwards'
        return (stamps - np.concatenate(self.truth)) / MS


def test_stamps_go_forward_although_readings_of_the_system_clock_scatter(monkeypatch):
    """A busy host reads the first samples late, and those that follow ever earlier."""
    rng = np.random.default_rng(2)
    monkeypatch.setattr(stamping, '_FOLLOW_NS', 0)
    monkeypatch.setattr(stamping, '_system_offset', lambda: (20_000, rng.integers(-9999, 9999)))
    stamper = stamping.Stamper(ClockMap(0.0), ())
    stamper.restart(1e6)
    late_ns = np.concatenate([np.linspace(300, 1, 400), np.ones(600)]) * MS
    for k, late in enumerate(late_ns.tolist()):
        device_ns = (2 * k + np.arange(2)) * MS
        stamper.add(stamping.Block(device_ns, np.zeros((2, 2)), {}), int(device_ns[-1] + late))
    stamps = stamper.take(nominal()).stamp_ns
    assert len(stamps) == 2000 and (np.diff(stamps) > 0).all()


@pytest.mark.parametrize(
    'ppm, min_ms, max_ms, delay_s',
    [(100, 0.0, 5.0, 0), (-100, 0.2, 5.2, 0), (100, 3.0, 8.0, 0.003), (0, 0.1, 5.1, 0)],
)
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


@pytest.mark.parametrize('step_ms', [400, -400, 30, -60, 3_600_000])
def test_a_step_of_the_device_clock_is_recognised(step_ms):
    frames = DelayedFrames(50, 0.05, 0.5)
    frames.run(1500)
    frames.run(1500, device_ms=step_ms)
    errors = frames.errors()
    assert frames.map.steps == 1
    assert np.abs(errors[:15000]).max() < 1
    assert np.abs(errors[15000 + 3000 :]).max() < 1.0, 'from three seconds after the step on'


def test_stamps_keep_their_distances_after_the_load_of_a_busy_host():
    frames = DelayedFrames(50, 0.05, 0.5)
    frames.run(1000)
    frames.run(200, late_ms=100)
    frames.run(1500)
    steps = np.diff(np.concatenate(frames.stamps))
    assert (steps < 0.4 * MS).sum() <= 1
    assert frames.map.steps == 1, 'seen as a step back, and then as what it was'
    assert np.abs(frames.errors()[-2000:]).max() < 1.0


def test_samples_that_come_in_a_burst_before_a_new_connection_were_delayed():
    stamper = stamping.Stamper(ClockMap(0.0, 0.5), ())
    stamper.restart(1e6)

    def send(first, last, late_ms):
        for number in range(first, last, 2):
            device_ns = (number + np.arange(2)) * MS
            arrived_ns = (last + late_ms) * MS if late_ms else int(device_ns[-1])
            stamper.add(stamping.Block(device_ns, np.zeros((2, 2)), {}), START + arrived_ns)

    send(0, 3000, 0)
    send(3000, 3004, 2000)
    stamper.restart(1e6)
    send(5300, 6300, 0)
    assert stamper.take(nominal()).missing == pytest.approx(5300 - 3004, abs=3)


def data(index, time_us=None, flags=0):
    """Return a frame of ten samples, by default at its time at 1 kHz."""
    time_us = index * 1000 if time_us is None else time_us
    return SampleFrame(flags, 0, time_us, index % 2**32, 0, np.zeros((10, 2)))


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
    base = 2**32 - 15
    _, accepted = counted(*(data(base + k, time_us=k * 1000) for k in (0, 10, 20, 50)))
    assert accepted == [(base, None, False), (base + 10, 0, False), (5, 0, False), (35, 20, False)]


def test_repeated_and_late_frames_are_not_accepted():
    counter, accepted = counted(
        data(0), data(10), data(10), data(0), data(20), data(50), data(30), data(60)
    )
    assert [i for i, *_ in accepted] == [0, 10, 20, 50, 60]
    assert [lost for _, lost, _ in accepted] == [None, 0, 0, 20, 0]
    assert counter.repeated == 30


def test_a_reset_begins_a_new_count_with_and_without_its_flag():
    _, accepted = counted(data(500), data(510), data(0, 100, AFTER_RESET), data(10, 10100))
    assert accepted == [(500, None, False), (510, 0, False), (0, None, False), (10, 0, False)]
    _, accepted = counted(data(500), data(510), data(30, 30100), data(50, 50100), data(60, 60100))
    assert accepted == [
        (500, None, False),
        (510, 0, False),
        (30, None, False),
        (50, 10, False),
        (60, 0, False),
    ]


@pytest.mark.parametrize(
    'index, away_s, lost',
    [(1010, 1.0, 1000), (10, 0.05, 0), (10, 9.0, 0), (1010, 3.0, None), (0, 1.0, None)],
)
def test_a_count_continues_across_a_closed_port_if_the_clocks_agree(index, away_s, lost):
    counter = FrameCounter()
    counter.restart(1000.0)
    counter.accept(data(0), 0)
    counter.reopened()
    counter.reopened()
    accepted = counter.accept(data(index), round(away_s * 1e9) + 10 * MS)
    assert [f.lost for f in accepted] == [lost]


@settings(max_examples=200)
@given(st.lists(st.integers(0, 60), max_size=60))
def test_no_frame_is_accepted_twice_or_out_of_order(order):
    _, accepted = counted(*(data(10 * k) for k in order), arrived_us=lambda f: 0)
    run = []
    for index, lost, _ in accepted:
        run = run + [index] if lost is not None else [index]
        assert run == sorted(set(run))
    assert len(accepted) <= len(order)


@pytest.mark.parametrize(
    'change, reason',
    [({'adc_bits': 0}, 'adc_bits'), ({'adc_bits': 24}, '24'), ({'serial': 'x' * 17}, 'serial')],
)
def test_a_sensor_beyond_the_wire_format_is_refused(change, reason):
    with pytest.raises(UserError, match=reason):
        emulated_board.check_sensor(replace(nominal(), **change))


@pytest.mark.parametrize('true_hz, used_hz', [(500.0, 500.0), (505.0, 500.0), (250.0, 250.0)])
@pytest.mark.parametrize('taken, lost', [(50, 0), (50, 12), (5, 40), (1, 0)])
def test_the_rate_of_a_clock_is_that_between_losses(true_hz, used_hz, taken, lost):
    """Buffers of some samples, with samples that are lost after each of them."""
    rate, rng = ClockRate(500.0), np.random.default_rng(1)
    numbers = np.flatnonzero(np.arange(2000) % (taken + lost) < taken)
    stamps_us = (numbers + rng.normal(0, 0.02, len(numbers))) / true_hz * 1e6
    for steps_us in np.array_split(np.diff(stamps_us), len(numbers) // taken):
        rate.compare_steps(steps_us)
    assert rate.used_hz == pytest.approx(used_hz, rel=0.01)
    assert bool(rate.fault) == (used_hz != 500)
