# SPDX-License-Identifier: Apache-2.0

"""Rests are found in a stream that a host stamps, and what is wrong with its stamps is named."""

from dataclasses import replace

from adxl_ros.calibrate.guided.rest_guides import HandGuide
from adxl_ros.model.sensor import to_volts
import numpy as np
import pytest
from units import nominal

G, RATE_HZ = 9.80665, 100.0
UP = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -1], [-1, 0, 0], [0, -1, 0]], float)


def tumbled() -> tuple[np.ndarray, np.ndarray]:
    """Return times, s, and specific force, m/s², of six rests with a second of motion between."""
    rng = np.random.default_rng(1)
    parts = []
    for up in UP:
        parts += [np.tile(G * up, (320, 1)), G * up + rng.normal(0, 4, (100, 3))]
    # A rest is taken once the stream has gone on for longer than a second after it.
    force = np.concatenate([*parts, parts[-1], parts[-1]])
    return np.arange(len(force)) / RATE_HZ, force + rng.normal(0, 0.02, force.shape)


def stalled(time_s: np.ndarray) -> np.ndarray:
    """Stamp the samples of a tenth of a second at once, each 1.7 s."""
    phase_s = time_s % 1.7
    return np.where(phase_s < 0.1, time_s - phase_s + 0.1 + 1e-4 * phase_s, time_s)


@pytest.mark.parametrize(
    'stamped',
    [
        lambda time_s: np.ceil(time_s / 4.25e-3) * 4.25e-3,
        stalled,
        lambda time_s: time_s - 0.015 * (np.arange(len(time_s)) % 50 == 49),
    ],
    ids=['polled', 'stalled', 'steps back'],
)
def test_all_rests_are_taken(stamped) -> None:
    time_s, force = tumbled()
    sensor = replace(
        nominal('xyz'),
        rate_hz=RATE_HZ,
        range_g=4.0,
        adc_bits=0,
        noise_density_g_per_rthz=np.full(3, 3e-4),
        rc_capacitance_f=0.0,
    )
    guide, faults = HandGuide(sensor, 3.0), set()
    stamps_ns, volts = np.rint(stamped(time_s) * 1e9).astype(np.int64), to_volts(force, sensor)
    for begin in range(0, len(stamps_ns), 7):
        faults.add(guide.feed(stamps_ns[begin : begin + 7], volts[begin : begin + 7]))
        if (record := guide.accept()) is not None:
            guide.take(record)
    assert len(guide.accepted) == len(UP)
    named = faults - {''}
    steps_back = (np.diff(stamps_ns) < 0).any()
    assert all('steps back' in fault for fault in named) and bool(named) == steps_back


def test_a_lasting_other_rate_is_named() -> None:
    time_s, force = tumbled()
    sensor = replace(nominal('xyz'), rate_hz=2 * RATE_HZ)
    guide = HandGuide(sensor, 3.0)
    fault = guide.feed(np.rint(time_s[:500] * 1e9).astype(np.int64), to_volts(force, sensor)[:500])
    assert 'samples are 100 a second by their stamps, but rate_hz is 200' in fault
