# SPDX-License-Identifier: Apache-2.0

"""An ADC with a Linux driver: Industrial I/O through libiio, on this machine or another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import time

from adxl_ros.errors import UserError
from adxl_ros.links.support import channels
from adxl_ros.links.support.base import (
    DeviceSettings,
    Level,
    LinkStatus,
    no_samples,
    option,
    Samples,
)
from adxl_ros.links.support.channels import clock_events, Stamper
from adxl_ros.links.support.clock_sync import ClockMap, IdentityMap
from adxl_ros.links.support.iio_stream import (
    AdcInfo,
    BufferSamples,
    import_libiio,
    open_stream,
    ReadError,
    Stream,
)
from adxl_ros.links.support.waiting import Backoff
from adxl_ros.model.sensor import Sensor

_SILENT_S = 0.5
"""Time without a buffer after which a device counts as silent, s. Chosen: 250 buffers."""
_SILENT_BUFFERS = 3
"""A device also counts as silent only after this many times the duration of its buffer."""
_BATCH_S = 0.02
"""Longest duration of the buffers that one read passes on together, s; chosen: passing twenty
samples on costs little more than passing two."""
_WAITING_SHARE = 0.5
"""A buffer has waited for the reader if its read takes less than this share of its duration."""
_DECISION_S = 0.5
"""Duration of late samples after which the clock of the device counts as stopped, s. Chosen: by
then a busy machine has read what the kernel keeps, each buffer with an answer of its own."""
_BACK_NS = 500_000_000
"""Stamps that go back by more belong to another clock, ns; others are samples that came before."""
_URI_KINDS = ('local:', 'ip:', 'usb:', 'serial:')
"""Kinds of libiio contexts that are real devices."""
_RATE_TOLERANCE = 1e-3
"""Relative difference from the declared rate above which the status names both."""


@dataclass(frozen=True)
class Settings(DeviceSettings):
    """Settings of the link."""

    # URI of the libiio context
    uri: str = option('local:', 'URI of libiio: local:, ip:HOST or ip:HOST:PORT, usb:...')
    # Name, id or label of the ADC; '' for the only one with buffered channels
    device: str = option('', 'name, id or label of the ADC; empty: the only one that has buffered '
                         'channels')
    # Ids or labels of the channels, or ROLE=ID: a list of strings, or one string with commas
    channels: str | Sequence[str] = option(
        (), 'ids or labels of x, y, z as the sensor has them, supply, temperature, or ROLE=ID; '
        'empty: the channels with these labels, else the first voltages')


@dataclass(frozen=True)
class Statistics:
    """Counts of the link, as diagnostics show them."""

    connections: int  # How often the device was opened
    repeated: int  # Samples that came twice
    # Duration of a buffer, ms: its first sample waits for as long; 0 without a device
    buffer_ms: float


def open_link(sensor: Sensor, settings: Settings) -> IioLink:
    """Check the settings; `IioLink.read` opens the context, and opens it again after each loss."""
    uri = settings.uri
    # Without a host libiio looks for one on the network, but the parameters choose the device.
    if not uri.startswith(_URI_KINDS) or uri == 'ip:' or not uri.isascii():
        raise UserError(f'link.uri: {uri!r} is none of local:, ip:HOST, usb:..., serial:...')
    import_libiio()
    return IioLink(sensor, settings)


class IioLink:
    """
    The samples of a buffered IIO device, stamped by its timestamp channel.

    The kernel does not count samples. Only the time stamps show a loss, so the number of missing
    samples is an estimate.
    """

    live = True
    waits_for_listener = False
    start_ns = None
    sensor: Sensor | None = None
    references = tuple(channels.COLUMNS.values())

    def __init__(self, sensor: Sensor, settings: Settings) -> None:
        """Prepare the link without opening the device."""
        self._declared, self._settings = sensor, settings
        self._entries = channels.parse_channels(settings.channels)
        self._layout = channels.Layout(sensor.axes, self.references, settings.supply_scale)
        self._stream: Stream | None = None
        self._stamper = Stamper(ClockMap(settings.delay, _DECISION_S))
        self._backoff = Backoff()
        self._error = ''
        self._adc: AdcInfo | None = None
        self._connections = self._repeated = 0
        self._last_ns: int | None = None
        self._is_behind = False
        self._last_buffer_s = time.monotonic()

    def begin(self, now_ns: int) -> int:
        """Do nothing: samples before the beginning do not count as lost."""
        return 0

    def read(self, now_ns: int) -> Samples:
        """Wait for a buffer and return its samples; without a device, wait for the device."""
        if self._stream is None:
            if self._backoff.wait():
                self._open()
        else:
            try:
                self._receive(self._stream)
            except (ReadError, UserError) as error:
                # After a time-out the stream is not reliable: everything is opened again.
                self._error = str(error)
                self.close()
                self._backoff.fail()
        samples = self._stamper.take()
        return no_samples(self._declared, time.time_ns()) if samples is None else samples

    def status(self) -> LinkStatus:
        """Return how the device and the clock work."""
        level, text = self._condition()
        clock = self._stamper.statistics()
        buffer_s = self._stream.buffer_s if self._stream else 0.0
        statistics = Statistics(self._connections, self._repeated, round(buffer_s * 1e3, 3))
        return LinkStatus(level, text, (statistics, clock), clock_events(clock))

    def close(self) -> None:
        """Close the device."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _condition(self) -> tuple[Level, str]:
        """Return level and text of the status."""
        # The URI of this machine is only a kind and a colon.
        uri, stream = self._settings.uri.removesuffix(':'), self._stream
        if self._error:
            return Level.ERROR, f'{uri}: {self._error}'
        if stream is None:
            return Level.OK, 'connecting'
        silent_s = time.monotonic() - self._last_buffer_s
        if silent_s > max(_SILENT_S, _SILENT_BUFFERS * stream.buffer_s):
            return Level.WARN, f'{uri}: silent, {stream.name} gives no samples'
        rate_hz, wanted_hz = stream.adc.rate_hz, self._declared.rate_hz
        difference = '' if abs(rate_hz / wanted_hz - 1) < _RATE_TOLERANCE else \
            f' ({wanted_hz:g} Hz were asked for)'
        return Level.OK, f'streaming at {rate_hz:g} Hz{difference}'

    def _open(self) -> None:
        """Try to open the device; a new ADC begins a new clock."""
        try:
            stream = open_stream(self._settings.uri, self._settings.device, self._entries,
                                 self._declared, self._settings)
        except (ReadError, UserError) as error:
            self._error = str(error)
            # To look for a USB device, libiio asks all that are on the bus.
            is_usb = self._settings.uri.startswith('usb:')
            self._backoff.fail(slow=is_usb or isinstance(error, UserError))
            return
        self._stream, self._error = stream, ''
        self._connections += 1
        self._last_buffer_s = time.monotonic()
        if stream.adc != self._adc:
            self._adc = stream.adc
            self.sensor = stream.adc.apply(self._declared)
            if stream.by_host_clock:
                self._stamper.clock = IdentityMap()
            self._stamper.restart(1e9 / stream.adc.rate_hz)
            self._last_ns = None

    def _receive(self, stream: Stream) -> None:
        """Read a buffer; where two in a row have waited for the reader, those behind them, too."""
        for _ in range(max(round(_BATCH_S / stream.buffer_s), 1)):
            began_s = time.monotonic()
            self._add(stream.read())
            was_behind = self._is_behind
            self._is_behind = time.monotonic() - began_s < _WAITING_SHARE * stream.buffer_s
            if not (was_behind and self._is_behind):
                return

    def _add(self, samples: BufferSamples) -> None:
        """Pass the samples of a buffer on, without those that came before."""
        arrived_ns = time.monotonic_ns()
        self._last_buffer_s = time.monotonic()
        self._backoff.reset()
        device_ns, values = samples.device_ns, samples.values
        newest_ns = -1 if self._last_ns is None else self._last_ns
        if device_ns[0] < newest_ns - _BACK_NS:
            self._stamper.restart(self._stamper.period_ns)
            newest_ns = -1
        new = []
        for stamp_ns in device_ns.tolist():
            new.append(stamp_ns > newest_ns)
            newest_ns = max(newest_ns, stamp_ns)
        self._repeated += len(new) - sum(new)
        if not any(new):
            return
        self._last_ns = newest_ns
        if not all(new):
            device_ns = device_ns[new]
            values = {role: column[new] for role, column in values.items()}
        self._stamper.add(self._layout.block(device_ns, values), arrived_ns, None)
