# SPDX-License-Identifier: Apache-2.0

"""What `import adxl_ros` takes as recordings, sensors and effects, and how it refuses others."""

from dataclasses import replace
import json

import adxl_ros as adxl
import numpy as np
import pandas as pd
import pytest

TIME_S = np.arange(2000) / 100.0
LOST = (TIME_S > 5.0) & (TIME_S < 6.0)
RNG = np.random.default_rng(4)
ACCEL = {
    f'a{axis}_mps2': level + RNG.normal(0, 0.02, len(TIME_S))
    for axis, level in zip('xyz', (0.1, 0.2, 9.8))
}
TABLE = pd.DataFrame({'time_s': TIME_S, **ACCEL})
RECORDING = adxl.from_arrays(time_s=TIME_S, **ACCEL)
VERBS = (adxl.apply, adxl.check, adxl.diagnose, adxl.fit, adxl.noise)


def refused(call, *named: str) -> None:
    """Check that a call is refused in one line that names some words and no option."""
    with pytest.raises(adxl.UserError) as error:
        call()
    text = str(error.value)
    assert all(word in text for word in named), text
    assert '--' not in text and '\n' not in text, text


@pytest.mark.parametrize(
    'gap',
    [
        {name: np.where(LOST, np.nan, values) for name, values in ACCEL.items()},
        {name: np.ma.array(values, mask=LOST) for name, values in ACCEL.items()},
        pd.DataFrame(ACCEL, dtype='Float64').where(pd.Series(~LOST), pd.NA, axis=0),
    ],
    ids=['nan', 'masked', 'missing'],
)
@pytest.mark.parametrize('rate_hz', [0.1, 100.0])
def test_a_gap_in_samples_at_a_rate_stays_a_gap(gap, rate_hz: float) -> None:
    recording = adxl.from_arrays(gap, rate=rate_hz)
    np.testing.assert_allclose(recording.time_s, np.flatnonzero(~LOST) / rate_hz)
    assert any('left out' in note for note in recording.notes)
    if isinstance(gap, pd.DataFrame):
        np.testing.assert_array_equal(adxl.read(gap, rate=rate_hz).time_s, recording.time_s)


def test_notes_on_arrays_name_no_option_of_a_tool() -> None:
    bursts_s = np.repeat(np.arange(50), 8) * 0.08 + np.tile(np.arange(8), 50) * 1e-5
    (note,) = adxl.from_arrays(time_s=bursts_s, ax_mps2=np.sin(bursts_s)).notes
    assert 'rate=' in note and '--' not in note


def test_a_rate_is_in_place_of_the_stamps() -> None:
    recording = adxl.from_arrays(time_s=TIME_S, rate=50, **ACCEL)
    np.testing.assert_allclose(recording.time_s, 2 * TIME_S)


def test_a_part_of_a_sample_is_left_out_where_it_is_said() -> None:
    part = {**ACCEL, 'ay_mps2': np.ma.array(ACCEL['ay_mps2'], mask=LOST)}
    refused(lambda: adxl.from_arrays(rate=100, **part), 'ay_mps2', 'drop_bad_samples=True')
    dropped = adxl.from_arrays(rate=100, drop_bad_samples=True, **part)
    assert len(dropped) == (~LOST).sum()


@pytest.mark.parametrize('make', [adxl.from_arrays, adxl.read])
def test_a_table_of_a_recording_is_that_recording_again(make) -> None:
    again = make(RECORDING.to_pandas())
    np.testing.assert_array_equal(again.time_s, RECORDING.time_s)
    np.testing.assert_array_equal(again.columns['az_mps2'], ACCEL['az_mps2'])


@pytest.mark.parametrize('make', [adxl.from_arrays, adxl.read])
def test_text_is_named_or_refused(make) -> None:
    (note,) = make(TABLE.assign(weather='fine')).notes
    assert 'weather' in note
    refused(lambda: make(TABLE.assign(ay_mps2='1.0')), 'ay_mps2')


@pytest.mark.parametrize('make', [adxl.from_arrays, adxl.read])
def test_arrays_without_a_time_need_one_or_a_rate(make) -> None:
    refused(lambda: make(pd.DataFrame(ACCEL)), 'give time_s or rate')


@pytest.mark.parametrize(
    'call, named',
    [
        (lambda: adxl.from_arrays(np.zeros((5, 3))), 'ndarray'),
        (lambda: adxl.read([1.0, 2.0]), 'list'),
        (lambda: adxl.from_arrays(time_s=TIME_S, ax_mps2=['a'] * 2000), 'ax_mps2'),
        (lambda: adxl.from_arrays(rate=0, **ACCEL), 'rate=0'),
        (lambda: adxl.from_arrays(rate='fast', **ACCEL), "rate='fast'"),
        (lambda: adxl.from_arrays(time_s=TIME_S[::-1], **ACCEL), 'drop_bad_stamps=True'),
        (lambda: adxl.from_arrays(time_s=1000 * TIME_S, **ACCEL), "columns='time=time_s:ms"),
        (lambda: adxl.read(TABLE, unit='furlongs'), 'furlongs'),
    ],
)
def test_no_array_is_refused_in_words_of_a_shell(call, named: str) -> None:
    refused(call, named)


@pytest.mark.parametrize(
    'call, named',
    [
        (lambda: adxl.simulate('rich', seed=1.5), 'seed=1.5'),
        (lambda: adxl.SensorModel('adxl203', seed='a'), "seed='a'"),
        (lambda: adxl.SensorModel('adxl203').reset(seed=-1), 'seed=-1'),
        (lambda: adxl.SensorModel('adxl203')(np.zeros(3), 'a'), "dt is 'a'"),
        (lambda: adxl.load(5), '5: is no path'),
        (lambda: RECORDING.save(5), '5: is no path'),
        (lambda: adxl.check(RECORDING).save(5), '5: is no path'),
        (lambda: adxl.check(RECORDING).junit(5), '5: is no path'),
    ],
)
def test_what_is_no_seed_no_time_step_and_no_path_is_named(call, named: str) -> None:
    refused(call, named)


@pytest.mark.parametrize('verb', VERBS)
def test_a_verb_refuses_what_is_no_recording_and_no_sensor(verb) -> None:
    for given in (np.zeros((5, 3)), 5, None):
        refused(lambda given=given: verb(given), type(given).__name__, 'expected a Recording')
    refused(lambda: verb(RECORDING, {'sensor': 1}), 'dict', 'expected a Sensor')


@pytest.mark.parametrize('verb', VERBS)
def test_a_value_that_is_lost_later_is_refused(verb) -> None:
    lost = np.where(LOST, np.nan, ACCEL['ay_mps2'])
    for values in (lost, np.ma.masked_invalid(lost), lost[:-1]):
        recording = replace(RECORDING, columns={**RECORDING.columns, 'ay_mps2': values})
        refused(lambda recording=recording: verb(recording), 'ay_mps2')


def test_a_table_is_a_recording_of_every_verb() -> None:
    assert len(adxl.apply(TABLE).time_s) == len(TABLE)
    assert adxl.check(TABLE).is_sound
    np.testing.assert_array_equal(
        adxl.noise(TABLE).allan_deviation_mps2, adxl.noise(RECORDING).allan_deviation_mps2
    )
    assert adxl.diagnose(TABLE, sim=TABLE).compared.sim
    assert len(adxl.simulate('imu', force=TABLE, rate=100)) == len(TABLE)


@pytest.mark.parametrize('verb', [adxl.diagnose, adxl.fit])
def test_the_same_samples_count_once(verb) -> None:
    refused(lambda: verb([RECORDING, TABLE]), 'same samples')


@pytest.mark.parametrize(
    'effects', ['misalignment', {'misalignment': 0.02}, None, ['no_such_effect'], [3]]
)
def test_effects_are_named_in_a_list_or_a_dict(effects) -> None:
    refused(lambda: adxl.simulate('tumble', effects=effects), 'effect')
    refused(lambda: adxl.load('adxl203', effects=effects), 'effect')
    refused(lambda: adxl.fit(RECORDING, effects=effects), 'effect')


def test_a_fit_refuses_a_model_and_effects_that_it_cannot_fit() -> None:
    refused(lambda: adxl.fit(RECORDING, model='cubic'), 'cubic', 'physical')
    refused(lambda: adxl.fit(RECORDING, effects=['hysteresis']), 'hysteresis', 'gravity')


def test_results_are_valid_json_with_none_for_what_is_not_known() -> None:
    one_axis = adxl.from_arrays(time_s=TIME_S, ax_mps2=ACCEL['ax_mps2'])
    for result in (adxl.apply(one_axis), adxl.noise(RECORDING), adxl.check(RECORDING)):
        json.dumps(result.to_dict(), allow_nan=False)
    values = adxl.apply(one_axis).to_dict()
    assert values['time_s'] == TIME_S.tolist() and values['roll_rad'][0] is None


def test_dates_are_the_time_of_a_recording() -> None:
    dates = pd.date_range('2026-01-01 00:00:00.25', periods=len(TIME_S), freq='10ms')
    for recording in (
        adxl.from_arrays(time_s=dates, **ACCEL),
        adxl.from_arrays(pd.DataFrame(ACCEL, index=dates)),
        adxl.read(pd.DataFrame(ACCEL, index=dates.rename('stamp'))),
    ):
        np.testing.assert_array_equal(recording.stamp_ns, dates.astype('M8[ns]').astype('int64'))


@pytest.mark.parametrize('verb', VERBS)
def test_arrays_by_name_are_a_recording(verb) -> None:
    table = {'time_s': TIME_S, **ACCEL}
    said = []
    for given in (table, pd.DataFrame(table)):
        try:
            said.append(str(verb(given)))
        except adxl.UserError as error:
            said.append(str(error))
    assert said[0].replace('arrays', 'DataFrame').split() == said[1].split()


def test_a_single_sample_is_refused_in_one_line() -> None:
    refused(lambda: adxl.apply(RECORDING.rows(0, 1)), 'do not show the noise')
