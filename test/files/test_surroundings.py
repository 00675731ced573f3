# SPDX-License-Identifier: Apache-2.0

"""What stands for temperature and supply where a recording has none, and that it is said."""

from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.surroundings import assumed, Surroundings
import numpy as np

TIME_S = 0.1 * np.arange(10)
NAN = np.nan


def block(temperature_c: list[float] | None, begin_s: float = 0.0) -> Recording:
    columns = {} if temperature_c is None else {'temperature_c': np.array(temperature_c)}
    count = len(columns.get('temperature_c', TIME_S))
    return Recording('made', begin_s + TIME_S[:count], columns)


def test_a_value_holds_over_blocks_until_the_next_one() -> None:
    surroundings = Surroundings()
    parts = [
        surroundings(block([NAN, 30, NAN, 31])),
        surroundings(block(None, 1.0)),
        surroundings(block([NAN, 40], 2.0)),
    ]
    filled = np.concatenate([part['temperature_c'] for part in parts])
    assert filled.tolist() == [25, 30, 30, 31, *[31] * 10, 31, 40]
    before, held = surroundings.assumed(['temperature_bias', 'temperature_scale'])
    assert '1 of 16 samples' in before and 'temperature_bias, temperature_scale at 25 °C' in before
    assert '12 of 16 samples, for 1.7 s at most' in held


def test_a_gap_behind_the_first_block_is_said() -> None:
    """The values of the first 8192 samples say nothing of those behind."""
    surroundings = Surroundings()
    assert surroundings(block([30.0] * 4))['temperature_c'].tolist() == [30] * 4
    assert not surroundings.assumed(['temperature_bias'])
    surroundings(block([NAN] * 4, 1.0))
    assert '4 of 8 samples' in surroundings.assumed(['temperature_bias'])[0]


def test_what_no_effect_follows_is_not_said() -> None:
    assert not assumed(block(None), ['bias'])
    assert 'supply_v is not recorded: supply at 5 V' in assumed(block(None), ['supply'])
    assert 'switched on at the first sample' in assumed(block(None), ['warm_up'])[0]
    assert '3 of 4 samples' in assumed(block([NAN, 30, NAN, NAN]), ['temperature_bias'])[0]
