# SPDX-License-Identifier: Apache-2.0

"""
Measure false alarms of the live comparison over days, and how soon it finds a change.

    python test/long/monitor_alarms.py            # block by block, many sensors: 4 minutes
    python test/long/monitor_alarms.py --chain    # one sensor through the whole chain: 20 minutes

The first form draws means of seconds. The second one simulates a sensor with flicker, random walk,
a temperature that swings by 10 K a day and a noisy thermometer, on a stage that moves between
poses.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import time

from adxl_ros.files import parameter_file
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.monitor.change_test import ChangeSettings, ChangeTest
from adxl_ros.monitor.live_gap import GapSettings, LiveGap
from adxl_ros.monitor.reference_stream import ReferenceKind
from adxl_ros.simulate.motion import Held, Knots, Motion
from adxl_ros.simulate.response import Response
from adxl_ros.tools.effect_option import with_effects
import numpy as np
from scipy.signal import lfilter

DAY_S = 86400
CHANNELS = 4
"""Series of a sensor: mean and noise of two axes."""
WHITE_UG, FLICKER_UG, WALK_UG = 78.0, 100.0, 1.0
"""Standard deviation of a mean of 1 s of an ADXL203, flicker at 1 Hz a root, step of a walk a
second, µg."""
PER_MONTH = 1 / 30


def flicker(rng: np.random.Generator, blocks: int, channels: int) -> np.ndarray:
    """Return 1/f noise of density 1 at 1 Hz, (blocks, channels), as relaxation processes."""
    total = np.zeros((blocks, channels))
    for corner_hz in 0.3 * 10 ** (-np.arange(12) / 2):
        decay = np.exp(-2 * np.pi * corner_hz)
        steps = rng.standard_normal((blocks, channels)) * np.sqrt(1 - decay ** 2)
        steps[0] /= np.sqrt(1 - decay ** 2)
        total += lfilter([1], [1, -decay], steps, axis=0)
    return np.sqrt(np.log(10) / 2) * total


def drifting(rng: np.random.Generator, kind: str, blocks: int, channels: int) -> np.ndarray:
    """Return means of seconds of a kind of noise, µg, (blocks, channels)."""
    means = WHITE_UG * rng.standard_normal((blocks, channels))
    if kind in ('flicker', 'all'):
        means += FLICKER_UG * flicker(rng, blocks, channels)
    if kind in ('walk', 'all'):
        means += np.cumsum(WALK_UG * rng.standard_normal((blocks, channels)), axis=0)
    if kind == 'all':
        phase = rng.random(channels)
        means += 500 * np.sin(2 * np.pi * (np.arange(blocks)[:, None] / DAY_S + phase))
    return means


def print_false_alarms(sensors: int, seed: int) -> None:
    """Print the false alarms of many sensors over a day, beside the stated rates."""
    for kind in ('white', 'flicker', 'walk', 'all'):
        for rate in (PER_MONTH, 1.0):
            rng = np.random.default_rng(seed)
            test = ChangeTest(ChangeSettings(CHANNELS * sensors, rate * sensors))
            means = drifting(rng, kind, DAY_S, CHANNELS * sensors)
            alarms = sum(len(test.add(row, False)) for row in means)
            print(f'{kind:8} {sensors} sensors for a day: {alarms} false alarms, stated at most '
                  f'{rate * sensors:.1f}', flush=True)


def print_delays(seed: int) -> None:
    """Print how soon steps of the mean are found after two hours of learning."""
    sensors = 100
    for kind in ('white', 'all'):
        for size_mg in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0):
            rng = np.random.default_rng(seed)
            means = drifting(rng, kind, 2 * 3600 + 1800, CHANNELS * sensors)
            means[7200:, ::CHANNELS] += 1e3 * size_mg
            test = ChangeTest(ChangeSettings(CHANNELS * sensors, PER_MONTH * sensors))
            delays: dict[int, int] = {}
            for second, row in enumerate(means):
                for change in test.add(row, False):
                    if change.channel % CHANNELS == 0 and second >= 7200:
                        delays.setdefault(change.channel, second - 7199)
            seconds = sorted(delays.values())
            times = f'median {np.median(seconds):.0f} s, 90 % within ' \
                f'{np.percentile(seconds, 90):.0f} s' if seconds else ''
            print(f'{kind:8} step of {size_mg} mg: found {len(seconds)} of {sensors} in 30 min '
                  f'{times}', flush=True)


def poses(rng: np.random.Generator, duration_s: float) -> Motion:
    """Return a motion between poses, at each of which the stage rests for 20 s to 10 min."""
    times, alphas, betas = [0.0], [0.5], [0.0]
    while times[-1] < duration_s:
        begin_s = times[-1] + rng.uniform(20, 600)
        times += [begin_s, begin_s + rng.uniform(2, 6)]
        alphas += [alphas[-1], rng.uniform(0.1, 1.5)]
        betas += [betas[-1], rng.uniform(-3, 3)]
    return Motion(np.inf, Knots(times, alphas), Knots(times, betas), Held(),
                  temperature_c=Day())


class Day:
    """A temperature that swings by 10 K a day."""

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return the temperature, °C."""
        return 25 + 5 * np.sin(2 * np.pi * time_s / DAY_S)


def turns(sensor: Sensor, motion: Motion, hours: float, seed: int) -> Iterator[LiveGap]:
    """Feed a comparison with ten seconds at a time, and yield it."""
    rng = np.random.default_rng(seed)
    respond = Response(sensor, motion, seed)
    live = LiveGap(sensor, ReferenceKind.STAGE,
                   GapSettings(false_alarms_per_day=PER_MONTH, history_s=60.0))
    step_rad = sensor.stage_resolution_rad
    for begin in range(0, round(hours * 3600), 10):
        time_s = begin + np.arange(round(10 * sensor.rate_hz)) / sensor.rate_hz
        live.add_samples(np.rint(time_s * 1e9).astype(np.int64) + 10 ** 15,
                         to_nominal_mps2(respond(time_s), sensor))
        at_s = begin + np.arange(500) / 50
        readings = np.column_stack([
            np.rint(motion.alpha(at_s) / step_rad) * step_rad,
            np.rint(motion.beta(at_s) / step_rad) * step_rad, np.zeros(len(at_s))])
        live.reference.add_readings(np.rint(at_s * 1e9).astype(np.int64) + 10 ** 15, readings)
        thermometer = Day()(np.array([float(begin)]))[0] + 0.1 * rng.standard_normal()
        live.reference.add_surroundings('temperature_c', 10 ** 15 + begin * 10 ** 9, thermometer)
        yield live


def print_chain(hours: float, seed: int) -> None:
    """Print the false alarms of one sensor through the whole chain."""
    nominal = parameter_file.load(parameter_file.nominal_path())
    sensor = with_effects(nominal, ['temperature_bias', 'misalignment', 'flicker', 'bias_walk'])
    sensor = Sensor(**{**vars(sensor), 'rate_hz': 50.0})
    motion = poses(np.random.default_rng(seed), hours * 3600)
    began_s, cpu_s, count = time.monotonic(), 0.0, 0
    live = None
    for live in turns(sensor, motion, hours, seed):
        before_s = time.process_time()
        for change in live.advance():
            print(f'false alarm: {change.text()} at {change.since_ns * 1e-9 - 1e6:.0f} s',
                  flush=True)
            count += 1
        cpu_s += time.process_time() - before_s
    assert live is not None
    print(f'seed {seed}: {hours:g} h through the chain, {live.counts.blocks} s compared: {count} '
          f'false alarms, stated at most {PER_MONTH * hours / 24:.2f}; {cpu_s:.0f} s of processor '
          f'time, {time.monotonic() - began_s:.0f} s', flush=True)


def main() -> None:
    """Run the chosen measurement."""
    parse = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parse.add_argument('--chain', action='store_true')
    parse.add_argument('--hours', type=float, default=24.0)
    parse.add_argument('--sensors', type=int, default=100)
    parse.add_argument('--seed', type=int, default=1)
    options = parse.parse_args()
    if options.chain:
        print_chain(options.hours, options.seed)
    else:
        print_false_alarms(options.sensors, options.seed)
        print_delays(options.seed)


if __name__ == '__main__':
    main()
