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

"""An ADC that Linux drives: industrial I/O through libiio, on this machine or another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
import time
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.links.support import channels
from adxl_ros.links.support.backoff import Retry
from adxl_ros.links.support.base import nothing, Option, Samples, State
from adxl_ros.links.support.clock_sync import ClockMap, HostStamps
from adxl_ros.links.support.iio_device import library, open_stream, ReadError, Stream
from adxl_ros.links.support.sample_stamps import Block, Timeline
from adxl_ros.model.sensor import Sensor
import numpy as np

OPTIONS = (
    Option('uri', 'local:', "libiio's: local:, ip:HOST or ip:HOST:PORT, usb:..."),
    Option('device', '', 'name, id or label of the ADC; empty: the only one that has buffered '
           'channels'),
    Option('channels', (), 'ids or labels in the order x, y, z as the sensor has them, supply, '
           'temperature, or ROLE=ID; empty: the labels of these names, else the first voltages'),
    Option('delay', 0.0, 'what the link takes at least from a sample to its arrival', 's',
           0.0, 1.0),
    channels.SUPPLY_SCALE,
)

_SILENT_S = 0.5
_BACK_NS = 500_000_000
"""Stamps that go back by this are another clock; by less, samples that were there before."""
_KINDS = ('local:', 'ip:', 'usb:', 'serial:')


def open_link(sensor: Sensor, options: Mapping[str, Any]) -> IioLink:
    """Check the options; the context is opened, and reopened for ever, by reading."""
    uri = options['uri']
    # Without a host libiio would look for one on the network: only parameters say what is read.
    if not uri.startswith(_KINDS) or uri == 'ip:' or not uri.isascii():
        raise UserError(f'link.uri: {uri!r} is none of local:, ip:HOST, usb:..., serial:...')
    library()
    return IioLink(sensor, options)


class IioLink:
    """
    The samples of a buffered IIO device, stamped by its timestamp channel.

    The kernel counts no samples: what is lost shows in the time stamps alone, so that every
    missing sample is estimated.
    """

    live = True
    waits = False
    start_ns = None
    sensor: Sensor | None = None

    def __init__(self, sensor: Sensor, options: Mapping[str, Any]) -> None:
        """Take what `OPTIONS` describe."""
        self._unit, self._options = sensor, options
        self._entries = channels.listed(options['channels'])
        self.references = ('supply_v', 'temperature_c')
        self._stream: Stream | None = None
        self._timeline = Timeline(ClockMap(options['delay']))
        self._retry = Retry()
        self._trouble = ''
        self._figures: Mapping[str, Any] = {}
        self._opened = self._repeated = 0
        self._last_ns: int | None = None
        self._heard_s = time.monotonic()

    def begin(self, now_ns: int) -> int:
        """Nothing is lost by a beginning: what was sampled before is nobody's."""
        return 0

    def read(self, now_ns: int) -> Samples:
        """Wait for a buffer and return its samples; without a device, wait for that."""
        if self._stream is None:
            if self._retry.wait():
                self._open()
        else:
            try:
                self._take(*self._stream.read())
            except (ReadError, UserError) as error:
                self._lose(str(error))
        samples = self._timeline.take()
        return nothing(self._unit, time.time_ns()) if samples is None else samples

    def state(self) -> State:
        """Say how the device and the clock are."""
        level, text = self._condition()
        return State(level, text, {
            'connections': self._opened, 'repeated': self._repeated, **self._timeline.values()})

    def close(self) -> None:
        """Let go of the device."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _condition(self) -> tuple[str, str]:
        if self._trouble:
            return 'error', f'{self._options["uri"]}: {self._trouble}'
        stream = self._stream
        if stream is None:
            return 'ok', 'connecting'
        if time.monotonic() - self._heard_s > max(_SILENT_S, 3 * stream.block_s):
            return 'warn', f'{self._options["uri"]}: silent, {stream.name} gives no samples'
        return 'ok', stream.about

    def _open(self) -> None:
        try:
            stream = open_stream(self._options['uri'], self._options['device'], self._entries,
                                 self._unit)
        except ReadError as error:
            self._trouble = str(error)
            self._retry.failed()
            return
        except UserError as error:
            self._trouble = str(error)
            self._retry.failed(slow=True)
            return
        self._stream, self._trouble = stream, ''
        self._opened += 1
        self._heard_s = time.monotonic()
        if stream.figures != self._figures:
            self._figures = stream.figures
            self.sensor = replace(self._unit, **stream.figures)
            if stream.by_host_clock:
                self._timeline.clock = HostStamps()
            self._timeline.restart(1e9 / stream.figures['rate_hz'])
            self._last_ns = None

    def _lose(self, why: str) -> None:
        # After a time-out the stream is not to be trusted: everything is built anew.
        self._trouble = why
        self.close()
        self._retry.failed()

    def _take(self, device_ns: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
        """Put samples on the timeline, those left out that were there before."""
        arrived_ns = time.monotonic_ns()
        self._heard_s = time.monotonic()
        self._retry.worked()
        last_ns = self._last_ns
        if last_ns is not None and device_ns[0] < last_ns - _BACK_NS:
            self._timeline.restart(self._timeline.period_ns)
            last_ns = None
        newest = np.maximum.accumulate(device_ns)
        before = np.concatenate([[-1 if last_ns is None else last_ns], newest[:-1]])
        fresh = device_ns > before
        self._repeated += int((~fresh).sum())
        if not fresh.any():
            return
        self._last_ns = int(newest[-1])
        self._timeline.put(Block(device_ns[fresh], *channels.split(
            {role: v[fresh] for role, v in values.items()}, self._unit, self.references,
            self._options['supply_scale'])), arrived_ns, None)
