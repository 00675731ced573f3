# SPDX-License-Identifier: Apache-2.0

"""Settings of a joint: the rule, and equal numbers from sweep, journal, bag and CSV."""

from adxl_ros.calibrate.joint_settings import recorded_settings, SettingTracker
import numpy as np
import pytest

NAN = float('nan')
STEP = 1e-3
TOLERANCE = 1.5 * STEP
RESTS = ((0, 10), (20, 30), (40, 50))


def by_rows(readings, commands, rests):
    return recorded_settings(
        np.array(rests), np.array(readings), np.array(commands), TOLERANCE
    ).tolist()


def by_tracker(readings, commands, rests):
    """Return the settings of a live sweep, whose readings and commands come one by one."""
    tracker = SettingTracker(TOLERANCE)
    numbers = []
    for row, (reading, command) in enumerate(zip(readings, commands)):
        tracker.read(row, reading, NAN)
        tracker.command(row, command, NAN)
        for start, stop in rests:
            # The sweep takes a pose some time after its end.
            if row == stop + 3:
                seen = [a for a in readings[start:stop] if np.isfinite(a)]
                pose = start, stop - 1, np.mean(seen) if seen else NAN, NAN
                numbers.append(tracker.settings(*pose)[0])
                tracker.take(*pose)
    return numbers


def changed(**parts):
    """Return 60 values of 0, except for rows such as `r20_30=value` for rows 20 to 30."""
    values = [0.0] * 60
    for rows, value in parts.items():
        first, stop = map(int, rows[1:].split('_'))
        values[first:stop] = [value] * (stop - first)
    return values


@pytest.mark.parametrize('number', [by_rows, by_tracker])
@pytest.mark.parametrize(
    ('readings', 'commands', 'settings'),
    [
        (changed(), changed(), [0, 0, 0]),
        # The encoder.
        (changed(r12_14=0.3), changed(), [0, 1, 1]),
        (changed(r12_13=1.6 * STEP), changed(), [0, 1, 1]),
        (changed(r12_14=STEP, r16_18=-STEP), changed(), [0, 0, 0]),
        (changed(r15_60=STEP), changed(), [0, 0, 0]),
        (changed(r15_60=2 * STEP), changed(), [0, 1, 1]),
        (changed(r15_35=0.3), changed(), [0, 1, 2]),
        # The end of a rest in a recording may contain the beginning of the next move.
        (changed(r29_60=2 * STEP), changed(), [0, 0, 1]),
        (changed(r14_22=-2 * STEP), changed(), [0, 1, 1]),
        # Rows without a reading.
        (changed(r11_19=NAN), changed(), [0, 0, 0]),
        (changed(r11_40=NAN), changed(), [0, 0, 0]),
        (changed(r11_40=NAN, r40_60=0.3), changed(), [0, 0, 1]),
        (changed(r18_40=NAN, r12_14=0.3), changed(), [0, 1, 1]),
        (changed(r0_60=NAN), changed(), [0, 0, 0]),
        # The command.
        (changed(), changed(r15_60=0.3), [0, 1, 1]),
        (changed(), changed(r12_14=0.3), [0, 1, 1]),
        (changed(), changed(r12_14=2e-9), [0, 1, 1]),
        # A controller reacts late, so that a rest continues after the next command.
        (changed(), changed(r22_60=0.3), [0, 0, 1]),
        (changed(), changed(r12_14=1e-10), [0, 0, 0]),
        (changed(), changed(r0_12=0.1, r12_20=NAN, r20_60=0.1), [0, 0, 0]),
        (changed(), changed(r0_12=0.1, r12_20=NAN, r20_60=0.2), [0, 1, 1]),
        (changed(), changed(r1_32=NAN), [0, 0, 0]),
        (changed(), changed(r0_60=NAN), [0, 0, 0]),
        (changed(), changed(r0_32=NAN), [0, 0, 1]),
        (changed(r0_60=NAN), changed(r15_30=0.1), [0, 1, 2]),
    ],
)
def test_a_joint_moves_with_its_encoder_or_its_command(number, readings, commands, settings):
    assert number(readings, commands, RESTS) == settings


def test_the_live_tracker_and_a_recording_agree():
    rng = np.random.default_rng(5)
    moves = 0
    for _ in range(300):
        walk = np.cumsum(rng.choice([0] * 30 + [1, -1, 2], 60)) * STEP
        readings = np.where(rng.random(60) < rng.choice([0, 0.3]), NAN, walk).tolist()
        drawn_rad = rng.integers(0, 3, 60) * 0.1
        commands = np.where(rng.random(60) < 0.98, NAN, drawn_rad).tolist()
        by_recording = by_rows(readings, commands, RESTS)
        assert by_tracker(readings, commands, RESTS) == by_recording
        moves += by_recording[-1]
    assert 200 < moves < 580
