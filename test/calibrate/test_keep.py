# SPDX-License-Identifier: Apache-2.0

"""A calibration that is kept: what is learnt, what never is, and what a kill leaves."""

from dataclasses import replace
import os
import signal
import time

from adxl_ros.calibrate.keep.keeper import Keeper
from adxl_ros.calibrate.keep.stays import RestStream
from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import Adopted, Journal, read
from adxl_ros_validation import kept_robots
from adxl_ros_validation.kept_robots import BEGIN_NS, calibrated, Kind, Robot
import numpy as np
import pytest

HEAD = {'serial': 'K1', 'kind': 'kept'}


def rests(kind, days, seed=3):
    robot = Robot(kind, np.random.default_rng(seed))
    return [rest for day in range(days) for rest, _ in robot.rests(day)]


def test_a_robot_that_lies_down_keeps_its_tilt_and_its_interval_holds():
    outcomes = [kept_robots.run(Kind(lies_down=True, slope=5), seed, 40) for seed in (0, 3)]
    assert sum(outcome.adoptions for outcome in outcomes) > 0
    assert sum(outcome.worse for outcome in outcomes) == 0
    assert sum(o.tilt_with_deg for o in outcomes) < sum(o.tilt_without_deg for o in outcomes)
    inside = np.sum([outcome.inside for outcome in outcomes]) / (3 * 80)
    # Days of a robot are no independent draws: the target `kept` has the coverage of many.
    assert inside > 0.75


@pytest.mark.parametrize(
    ('kind', 'seed'),
    [
        (Kind(knock_axis=2, knock_mg=3), 5),
        (Kind(True, knock_mg=-8), 5),
        (Kind(is_turned=True, knock_mg=8), 1),  # Other directions show it as a drift, too.
    ],
)
def test_a_knock_is_reported_and_never_learnt(kind, seed):
    outcome = kept_robots.run(kind, seed, 40)
    assert outcome.reported_days < 2
    assert outcome.adoptions_after == 0
    assert outcome.false_changes == 0


def test_one_rest_reports_a_large_knock():
    outcome = kept_robots.run(Kind(lies_down=True, knock_mg=20), 5, 31)
    assert outcome.could_show and outcome.reported_days < 0.1


def test_a_knock_that_no_rest_can_show_is_never_adopted():
    """Slopes of the ground show a knock on x in the length of gravity, as a drift of weeks."""
    outcome = kept_robots.run(Kind(knock_mg=20), 4, 45)
    assert outcome.adoptions_after > 0 and not outcome.is_learnt


def test_the_interval_of_a_sensor_of_two_axes_holds():
    """Two axes do not show the length of gravity: it learns from the changes within stays."""
    inside = []
    for seed in (0, 1):
        robot = Robot(Kind(True, slope=5, axes='xy'), np.random.default_rng(seed))
        keeper = Keeper(calibrated('xy'))
        for day in range(20):
            for rest, _ in robot.rests(day):
                keeper.add(rest)
            state = keeper.state(rest.stop_ns)
            true_mg = 1e3 * robot.zero_g(rest.temperature_c)[:2]
            inside += [*(np.abs(true_mg - state.total_mg) <= state.zero_g_90_mg)]
    assert np.mean(inside) > 0.75
    assert np.isnan(state.tilt_90_deg) and not state.changed
    assert state.determined[0] == 'zero-g x: as calibrated, and ageing'


def test_places_that_show_nothing_of_a_zero_g_leave_its_interval():
    """One rest at each of many places says nothing of two axes, however many they are."""
    rest = rests(Kind(axes='xy'), 1)[0]
    stamps_ns = [rest.start_ns + number * 3600 * 10**9 for number in range(500)]
    keeper = Keeper(calibrated('xy'))
    for stay, stamp_ns in enumerate(stamps_ns):
        keeper.add(replace(rest, stay=stay, start_ns=stamp_ns, stop_ns=stamp_ns + 10**9))
    alone = Keeper(calibrated('xy'), entries=[rest]).state(stamps_ns[-1])
    many_mg, alone_mg = keeper.state(stamps_ns[-1]).zero_g_90_mg, alone.zero_g_90_mg
    assert many_mg == pytest.approx(alone_mg, rel=0.01)


def test_a_slope_of_weeks_is_not_learnt_as_zero_g():
    robot = Robot(Kind(weeks_deg=5.0), np.random.default_rng(3))
    taken = [rest for day in range(36) for rest, _ in robot.rests(day)]
    sloping = Keeper(calibrated(), entries=taken).state(taken[-1].stop_ns, 25.0)
    # 5° are 87 mg.
    departure_mg = np.abs(1e3 * robot.zero_g(25.0) - sloping.total_mg)
    assert (departure_mg < 1.5 * np.array(sloping.zero_g_90_mg)).all()
    assert max(sloping.zero_g_90_mg) < 6
    assert 'only the sum of zero-g and scale factor of z is seen' in sloping.determined


def test_a_calibration_without_rests_ages_and_leaves_its_temperature():
    keeper = Keeper(calibrated())
    keeper.add(rests(Kind(), 1)[0])
    now, later = (keeper.state(BEGIN_NS + days * 86400 * 10**9, 25.0) for days in (1, 300))
    warmer = keeper.state(BEGIN_NS + 86400 * 10**9, 40.0)
    assert now.tilt_90_deg < warmer.tilt_90_deg < later.tilt_90_deg
    assert later.age_days == pytest.approx(300)


def test_a_restart_after_any_line_goes_on_and_undo_goes_back(tmp_path):
    days = rests(Kind(lies_down=True, slope=5), 20)
    journal = Journal(tmp_path / 'j', HEAD)
    keeper = Keeper(calibrated(), write=journal.append)
    for rest in days:
        keeper.add(rest)
    journal.close()
    path = tmp_path / 'j'
    journal = Journal(path, HEAD)
    journal.close()
    entries = journal.entries
    adopted = max(n for n, entry in enumerate(entries) if isinstance(entry, Adopted))
    lines = path.read_bytes().splitlines(keepends=True)
    # Some rests before the adoption, which comes when it would have come
    cut = len(lines) - len(entries) + adopted - 5
    path.write_bytes(b''.join(lines[:cut]) + lines[cut][:20])
    journal = Journal(path, HEAD)
    again = Keeper(calibrated(), entries=journal.entries, write=journal.append)
    taken = sum(not isinstance(entry, Adopted) for entry in journal.entries)
    for rest in days[taken:]:
        again.add(rest)
    assert again.state(days[-1].stop_ns) == keeper.state(days[-1].stop_ns)
    before = len(again.adoptions)
    again.undo(days[-1].stop_ns)
    journal.close()
    journal = Journal(path, HEAD)
    restarted = Keeper(calibrated(), entries=journal.entries)
    assert len(restarted.adoptions) == before - 1
    np.testing.assert_array_equal(
        restarted.sensor.values['bias']['offset_v'], again.sensor.values['bias']['offset_v']
    )
    journal.close()


def keep_on(path, days, acknowledge_fd):
    """Take the rests that the journal lacks, and acknowledge each; for a process of its own."""
    journal = Journal(path, HEAD)
    keeper = Keeper(calibrated(), entries=journal.entries, write=journal.append)
    for rest in days[len(journal.entries) :]:
        keeper.add(rest)
        os.write(acknowledge_fd, b'.')
    os._exit(0)


def test_no_kill_at_a_random_moment_loses_a_rest(tmp_path):
    days, path, rng = rests(Kind(), 6), tmp_path / 'j', np.random.default_rng(4)
    kept = 0
    for _ in range(10):
        acknowledged_fd, acknowledge_fd = os.pipe()
        process = os.fork()
        if not process:
            keep_on(path, days, acknowledge_fd)
        os.close(acknowledge_fd)
        count = len(os.read(acknowledged_fd, 1))
        time.sleep(rng.uniform(0, 0.03))  # the random moment
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        while acknowledged := os.read(acknowledged_fd, 4096):
            count += len(acknowledged)
        os.close(acknowledged_fd)
        entries = read(path).entries
        assert [*entries] == days[: len(entries)]
        assert len(entries) >= kept + count
        kept = len(entries)
    assert kept > 10


def test_a_dry_run_reports_and_adopts_nothing():
    keeper = Keeper(calibrated(), may_adopt=False)
    proposals = set()
    for rest in rests(Kind(lies_down=True, slope=5), 20):
        assert keeper.add(rest) is None
        proposals.add(keeper.state(rest.stop_ns).proposal)
    assert any('mg' in proposal for proposal in proposals)
    with pytest.raises(UserError, match='nothing to undo'):
        keeper.undo(0)


def test_a_calibration_without_uncertainty_is_refused():
    with pytest.raises(UserError, match='no uncertainty of its zero-g'):
        Keeper(calibrated().without_covariance())


def stream_of(motions, sensor, rate_hz=100):
    """Return stamps and volts of parts of a duration, a force, and an amplitude of vibration."""
    rng, parts = np.random.default_rng(1), []
    for seconds, force, amplitude in motions:
        time_s = np.arange(seconds * rate_hz) / rate_hz
        shaken = amplitude * np.sin(2 * np.pi * 13 * time_s)[:, None]
        parts.append(np.array(force) + shaken + rng.normal(size=(len(time_s), 3)) * 5e-4)
    volts = 2.5 + np.concatenate(parts)
    return BEGIN_NS + np.arange(len(volts)) * (10**9 // rate_hz), volts


def test_rests_of_one_stay_are_told_from_others_and_vibration_is_no_rest():
    sensor = replace(calibrated(), rate_hz=100.0)
    stamps_ns, volts = stream_of(
        [
            (400, (0, 0, 1), 0),
            (3, (0.2, 0, 1), 0.2),
            (40, (0, 0.1, 0.995), 0),
            (60, (0, 0, 1), 0.02),
        ],
        sensor,
    )
    stream = RestStream(sensor)
    stream.add_temperature(stamps_ns[::100], np.full(len(stamps_ns[::100]), 30.0))
    found = []
    for part in np.array_split(np.arange(len(stamps_ns)), 77):
        found += stream.add(stamps_ns[part], volts[part])
    found += stream.finish()
    stays = [rest.stay for rest in found]
    assert stays == sorted(stays) and stays.count(stays[0]) == 2  # one in five minutes
    assert {round(rest.mean_v[1] - 2.5, 2) for rest in found} == {0.0, 0.1}
    assert all(rest.stop_ns <= stamps_ns[0] + 444 * 10**9 for rest in found)
    silent = RestStream(sensor)
    assert [*silent.add(stamps_ns, volts), *silent.finish()] == []
    assert silent.counts['without_temperature'] > 0
