# SPDX-License-Identifier: Apache-2.0

"""The IIO link with the real libiio, on a small IIOD: formats, rates, channels, faults."""

import json
import time

from adxl_ros.errors import UserError
from adxl_ros.links import iio
from adxl_ros.links.support.base import Level
import iiod
from needs import lack
import numpy as np
from processes import PATIENCE
import pytest
from rig import ScriptProcess
from units import nominal

pytestmark = pytest.mark.long


@pytest.fixture(scope='module', autouse=True)
def library():
    try:
        iio.import_libiio()
    except UserError:
        pytest.skip(lack('libiio', 'libiio0'))


@pytest.fixture
def served():
    opened = []

    def serve(sensor=None, adc=None, **settings):
        server = ScriptProcess('iiod.py', json.dumps(adc or {}))
        link = iio.open_link(
            sensor or nominal(), iio.Settings(uri=f'ip:127.0.0.1:{server.first_line}', **settings)
        )
        link.begin(0)
        opened.append((server, link))
        return server, link

    yield serve
    for server, link in opened:
        link.close()
        server.kill()


def read_samples(link, count, timeout_s=60.0):
    parts, end_s = [], time.monotonic() + timeout_s
    while sum(len(part.stamp_ns) for part in parts) < count and time.monotonic() < end_s:
        parts.append(link.read(0))
    return parts


def read_until(condition, link, count=0):
    """Read samples until a condition holds: a busy machine loses samples, or the link."""
    read_samples(link, count)
    end_s = time.monotonic() + PATIENCE * 10
    while not condition():
        assert time.monotonic() < end_s, link.status()
        link.read(0)


def column(name, parts):
    return np.concatenate([part.references[name] for part in parts if len(part.stamp_ns)])


FORMATS = [
    'le:u16/16>>0',
    'be:u16/16>>0',
    'le:u12/16>>4',
    'be:s12/16>>4',
    'le:s24/32>>8',
    'be:u24/32>>8',
    'le:s16/16>>0',
    'le:s8/8>>0',
    'be:s18/32>>0',
]


@pytest.mark.parametrize('form', FORMATS)
def test_every_format_gives_the_volts_of_its_codes(served, form):
    scale, offset = 0.05, -3
    adc = {
        'channels': [
            {'id': 'voltage0', 'format': form, 'scale': scale, 'offset': offset},
            {'id': 'voltage1', 'format': form, 'scale': scale},
        ]
    }
    _, link = served(adc=adc)
    volts = np.concatenate([part.volts for part in read_samples(link, 200)])
    assert len(volts) >= 200
    parsed = iiod.parse_format({'format': form})
    bits, shift = parsed.bits, 2 ** (parsed.bits - 1) if parsed.sign == 's' else 0
    codes = np.rint(volts[:, 0] / (scale * 1e-3)) - offset + shift
    first = int(codes[0]) - 1
    k = first + np.arange(len(codes))
    assert np.array_equal(codes, iiod.code(k, 0, bits))
    other_codes = np.rint(volts[:, 1] / (scale * 1e-3)) + shift
    # A code of few bits determines the number of a sample only up to its period.
    period = 2**bits - 2
    turns = np.arange(3 if period % 3 == 0 else 1) * period
    assert any(np.array_equal(other_codes, iiod.code(k + turn, 1, bits)) for turn in turns)


@pytest.mark.parametrize(
    'entries',
    [
        'voltage1,voltage0,voltage2',
        ['y=voltage0', 'x=voltage1', 'supply=voltage2'],
        'right,left,voltage2',
    ],
)
def test_channels_are_named_by_id_label_or_role(served, entries):
    _, link = served(
        adc={
            'channels': [
                {'id': 'voltage0', 'label': 'left', 'scale': 1.0},
                {'id': 'voltage1', 'label': 'right', 'scale': 2.0},
                {'id': 'voltage2', 'scale': 3.0},
            ]
        },
        channels=entries,
    )
    parts = read_samples(link, 300)
    first = next(part for part in parts if len(part.volts)).volts[0]
    k = round(first[1] / 1e-3) - 1
    assert round(first[0] / 2e-3) == iiod.code(k, 1, 16)
    assert np.isfinite(column('supply_v', parts)).any()


def test_the_rate_is_set_and_read_back(served):
    _, link = served(nominal(rate_hz=500.0))
    read_samples(link, 100)
    assert link.sensor.rate_hz == 500
    assert link.status().text == 'streaming at 500 Hz'
    _, link = served(nominal(rate_hz=900.0), {'rates': [475, 860], 'rate': 860})
    read_samples(link, 100)
    assert link.sensor.rate_hz == 860
    assert link.status().text == 'streaming at 860 Hz'


def test_a_device_that_samples_at_half_the_stated_rate_is_named(served):
    _, link = served(nominal(rate_hz=500.0), {'share': 0.5})
    read_until(lambda: 'states 500 Hz' in link.status().text, link)
    status = link.status()
    assert status.level is Level.ERROR
    assert '250 samples a second' in status.text
    assert link.sensor.rate_hz == pytest.approx(250, rel=0.01)
    # By the stated rate one sample would be missing before each.
    parts = read_samples(link, 200)
    assert sum(part.missing for part in parts) < sum(len(part.stamp_ns) for part in parts)


def test_a_device_that_is_opened_again_has_the_rate_of_its_clock(served):
    """A rate that was corrected before the loss is not kept as if it were the stated one."""
    server, link = served(nominal(rate_hz=500.0), {'share': 0.5})
    read_until(lambda: abs(link.sensor.rate_hz - 250) < 2.5, link, 1)
    before = link.status().statistics['connections']
    server.kill()
    again = ScriptProcess('iiod.py', json.dumps({'port': int(server.first_line)}))
    try:
        read_until(lambda: link.status().statistics['connections'] > before, link)
        assert link.sensor.rate_hz == 500
        # The rate is compared several times within so many samples.
        read_until(lambda: link.status().text == 'streaming at 500 Hz', link, 800)
        assert link.sensor.rate_hz == 500
    finally:
        again.kill()


def test_steady_loss_is_no_other_rate(served):
    _, link = served(nominal(rate_hz=500.0), {'loses': (50, 12)}, latency_ms=100.0)
    parts = read_samples(link, 800)
    assert link.status().text == 'streaming at 500 Hz'
    assert link.sensor.rate_hz == 500
    missing, taken = (sum(part.missing for part in parts), sum(len(p.stamp_ns) for p in parts))
    assert missing / taken == pytest.approx(12 / 50, rel=0.2), 'the loss is counted'


def test_a_digital_sensor_gives_pseudo_volts(served):
    sensor = nominal('xyz')
    _, link = served(
        sensor,
        {
            'channels': [
                {'id': f'accel_{a}', 'format': 'le:s16/16>>0', 'scale': 0.01} for a in 'xyz'
            ]
        },
    )
    volts = np.concatenate([part.volts for part in read_samples(link, 50)])
    mps2 = (volts[:, 0] - 2.5) * 9.80665
    assert np.rint(mps2 / 0.01) == pytest.approx(mps2 / 0.01, abs=1e-6)
    assert link.sensor.adc_bits == 0


@pytest.mark.parametrize(
    'adc, settings, reason',
    [
        (
            {'channels': [{'id': 'voltage0', 'scale': None}, {'id': 'voltage1'}]},
            {},
            "voltage0: its attribute scale is 'missing', not a number",
        ),
        ({'channels': [{'id': 'voltage0', 'scale': 'nan'}, {'id': 'voltage1'}]}, {}, "is 'nan'"),
        (
            {'channels': [{'id': 'voltage0', 'offset': None}, {'id': 'voltage1'}]},
            {},
            "offset is 'missing'",
        ),
        ({}, {'channels': 'voltage0,voltage9'}, "no channel 'voltage9'; it has voltage0, "),
        ({}, {'channels': 'voltage0'}, 'the channels are x; expected'),
        ({'unstamped': True}, {}, 'timestamp'),
        (
            {},
            {'device': 'ads9999'},
            "'ads9999' is not there; with buffered channels there are: adc",
        ),
        (
            {'channels': [{'id': 'temp'}, {'id': 'voltage1'}]},
            {'channels': 'temp,voltage1'},
            'temp cannot be x',
        ),
    ],
)
def test_a_misfit_is_reported_and_no_value_invented(served, adc, settings, reason):
    _, link = served(adc=adc, **settings)
    assert not sum(len(part.stamp_ns) for part in read_samples(link, 1, 0.4))
    status = link.status()
    assert status.level == Level.ERROR
    assert reason in status.text, status.text


def test_a_buffer_is_as_long_as_the_latency(served):
    durations_ms = []
    for latency_ms in (2.0, 100.0):
        _, link = served(latency_ms=latency_ms)
        read_samples(link, 400)
        durations_ms.append(link.status().statistics['buffer_ms'])
    # A busy machine answers late, which makes buffers longer.
    assert 2.0 <= durations_ms[0] < 100.0 <= durations_ms[1]


@pytest.mark.parametrize(
    'scatter_ns',
    [
        60_000,  # beside other tests
        pytest.param(20_000, marks=pytest.mark.perf),
    ],
)
def test_stamps_are_those_of_the_devices_clock(served, scatter_ns):
    _, link = served(adc={'ppm': 80, 'offset_ns': -3_000_000_000})
    parts, scatter, end_s = [], np.inf, time.monotonic() + PATIENCE * 60
    # The map approaches the drift of 80 ppm within some seconds, on a busy machine within more.
    while scatter > scatter_ns:
        assert time.monotonic() < end_s, f'scatter {scatter:.0f} ns'
        read = read_samples(link, 2000)
        assert abs(time.time_ns() - read[-1].stamp_ns[-1]) < 1e9, 'not the time of the device'
        parts += read
        stamps = np.concatenate([part.stamp_ns for part in read])
        periods = np.cumsum([0, *np.rint(np.diff(stamps) * 1e-6)])
        line = np.polyval(np.polyfit(periods, stamps - stamps[0], 1), periods)
        scatter = (stamps - stamps[0] - line).std()
    assert (np.diff(np.concatenate([part.stamp_ns for part in parts])) > 0).all()


@pytest.mark.parametrize('uri', ['', 'ip:', 'xml:/etc/passwd', 'adc', 'ip:\u00e4'])
def test_a_uri_that_names_no_device_is_refused(uri):
    with pytest.raises(UserError, match=r'link\.uri'):
        iio.open_link(nominal(), iio.Settings(uri=uri))
