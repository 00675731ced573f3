# SPDX-License-Identifier: Apache-2.0

"""An ADC with a Linux driver: Industrial I/O through libiio, on this machine or another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from math import ceil, isfinite
import os
import time
from typing import Any

from adxl_ros.errors import install_hint, UserError
from adxl_ros.links.support import stamping
from adxl_ros.links.support.base import (
    Backoff,
    check_roles,
    COLUMNS,
    DeviceSettings,
    Level,
    Link,
    LinkStatus,
    option,
    parse_channels,
    reason,
    Samples,
    SUPPLY,
    TEMPERATURE,
)
from adxl_ros.links.support.clock_map import ClockMap, IdentityMap
from adxl_ros.links.support.clock_rate import ClockRate
from adxl_ros.links.support.stamping import Stamper
from adxl_ros.links.support.wire_format import RATES_HZ
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
import numpy as np

_SILENT_S = 0.5
"""Time without a buffer after which a device counts as silent, s. Chosen: 250 buffers."""
_SILENT_BUFFERS = 3
"""A device also counts as silent only after this many times the duration of its buffer."""
_DECISION_S = 0.5
"""Duration of late samples after which the clock of the device counts as stopped, s. Chosen: by
then a busy machine has read what the kernel keeps, each buffer with an answer of its own."""
_BACK_NS = 500_000_000
"""Stamps that go back by more belong to another clock, ns; others are samples that came before."""
_URI_KINDS = ('local:', 'ip:', 'usb:', 'serial:')  # Kinds of libiio contexts that are real devices


_KEPT_S = 0.32
"""Duration of the samples that the kernel keeps while nobody reads, s; chosen: a busy machine
delays a read by less."""
_MIN_KERNEL_BUFFERS = 4  # Fewest buffers of the kernel, the default of libiio
_MAX_KERNEL_BUFFERS = 320
"""Most buffers of the kernel; chosen: single samples at 1 kHz are kept as long as others, and its
memory has a bound at high rates."""
_ANSWERS = 20  # Answers of a device that are timed when it is opened
_ROUND_TRIPS = 4.0
"""Shortest duration of a buffer by the mean time of an answer. Chosen: each buffer needs one,
so that the reads catch up with four times the sample rate after a delay."""
_MAX_BUFFER = 2000  # Most samples of a buffer
_TIMEOUT_S = 1.0
"""Lateness after which a buffer will not come, s: the server was killed or stopped."""
_CLOCK_ATTRIBUTE = 'current_timestamp_clock'
"""Attribute of the kernel that selects the clock of the time stamps."""
_MAX_STAMP_NS = 2**62  # Largest plausible time stamp, ns
_INSTALL = (
    'link.type iio needs the Python package pylibiio and the library libiio 0.x: '
    f'{install_hint("pylibiio<1")} and sudo apt install libiio0'
)
"""What a user is told where libiio is not installed."""


@dataclass(frozen=True)
class Settings(DeviceSettings):
    """Settings of the link."""

    uri: str = option('local:', 'URI of libiio: local:, ip:HOST or ip:HOST:PORT, usb:...')
    device: str = option(
        '', 'name, id or label of the ADC; empty: the only one that has buffered channels'
    )
    # A list of strings, or one string with commas
    channels: str | Sequence[str] = option(
        (),
        'ids or labels of x, y, z as the sensor has them, supply, temperature, or ROLE=ID; '
        'empty: the channels with these labels, else the first voltages or accelerations',
    )


def open_link(sensor: Sensor, settings: Settings) -> IioLink:
    """Check the settings; `IioLink.read` opens the context, and opens it again after each loss."""
    uri = settings.uri
    # Without a host libiio looks for one on the network, but the parameters choose the device.
    if not uri.startswith(_URI_KINDS) or uri == 'ip:' or not uri.isascii():
        raise UserError(f'link.uri: {uri!r} is none of local:, ip:HOST, usb:..., serial:...')
    import_libiio()
    return IioLink(sensor, settings)


class IioLink(Link):
    """
    The samples of a buffered IIO device, stamped by its timestamp channel.

    The kernel does not count samples. Only the time stamps show a loss, so the number of missing
    samples is an estimate.
    """

    references = tuple(COLUMNS.values())

    def __init__(self, sensor: Sensor, settings: Settings) -> None:
        self._declared = sensor
        self._settings = settings
        self._entries = parse_channels(settings.channels)
        self._stream: _Stream | None = None
        self._stamper = Stamper(ClockMap(settings.delay, _DECISION_S), self.references)
        self._backoff = Backoff()
        self._error = ''
        self._rate = ClockRate(sensor.rate_hz)
        self._adc: dict[str, float] = {}
        self._connections = self._repeated = 0
        self._newest_ns = -1
        self._last_buffer_s = time.monotonic()

    def read(self, now_ns: int) -> Samples:
        """Wait for a buffer and return its samples; without a device, wait for the device."""
        if self._stream is None:
            if self._backoff.wait():
                self._open()
        else:
            try:
                self._add(*self._stream.read())
            except (_ReadError, UserError) as error:
                # After a time-out the stream is not reliable: everything is opened again.
                self._error = str(error)
                self.close()
                self._backoff.fail()
        return self._stamper.take(self._declared)

    def status(self) -> LinkStatus:
        """Return how the device and the clock work."""
        level, text = self._condition()
        buffer_s = self._stream.buffer_s if self._stream else 0.0
        return LinkStatus(
            level,
            text,
            {
                'connections': self._connections,
                'repeated': self._repeated,
                'buffer_ms': round(buffer_s * 1e3, 3),
                **self._stamper.statistics(),
            },
            self._stamper.events(),
        )

    def close(self) -> None:
        """Close the device."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _condition(self) -> tuple[Level, str]:
        # The URI of this machine is only a kind and a colon.
        uri = self._settings.uri.removesuffix(':')
        stream = self._stream
        if self._error:
            return Level.ERROR, f'{uri}: {self._error}'
        if stream is None:
            return Level.OK, 'connecting'
        silent_s = time.monotonic() - self._last_buffer_s
        if silent_s > max(_SILENT_S, _SILENT_BUFFERS * stream.buffer_s):
            return Level.WARN, f'{uri}: silent, {stream.name} gives no samples'
        if contradiction := self._rate.fault:
            return (
                Level.ERROR,
                f'{uri}: {stream.name} {contradiction}: its sampling_frequency, or '
                'sensor.rate_hz where it has none',
            )
        return Level.OK, f'streaming at {stream.rate_hz:g} Hz'

    def _open(self) -> None:
        """Try to open the device; another ADC or rate than before begins a new clock."""
        uri = self._settings.uri
        try:
            stream = _open_stream(self._settings, self._entries, self._declared)
        except (_ReadError, UserError) as error:
            self._error = str(error)
            # To look for a USB device, libiio asks all that are on the bus.
            self._backoff.fail(slow=uri.startswith('usb:') or isinstance(error, UserError))
            return
        self._stream = stream
        self._error = ''
        self._connections += 1
        self._last_buffer_s = time.monotonic()
        is_other_rate = self._rate.used_hz != stream.rate_hz
        self._rate = ClockRate(stream.rate_hz)
        adc = stream.adc
        if adc != self._adc or is_other_rate:
            self._adc = adc
            self.sensor = replace(self._declared, **adc)  # type: ignore[arg-type]
            if stream.by_host_clock:
                self._stamper.clock = IdentityMap()
            self._stamper.restart(1e9 / stream.rate_hz)
            self._newest_ns = -1

    def _add(self, device_ns: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
        """Pass the samples of a buffer on, without those that came before."""
        arrived_ns = time.monotonic_ns()
        self._last_buffer_s = time.monotonic()
        self._backoff.reset()
        if device_ns[0] < self._newest_ns - _BACK_NS:
            self._stamper.restart(self._stamper.period_ns)
            self._newest_ns = -1
        newest_ns = np.maximum.accumulate(np.append(self._newest_ns, device_ns))
        new = device_ns > newest_ns[:-1]
        taken_ns = newest_ns[np.append(self._newest_ns >= 0, new)]
        self._newest_ns = int(newest_ns[-1])
        self._repeated += len(new) - int(new.sum())
        if self._rate.compare_steps(1e-3 * np.diff(taken_ns)):
            assert self.sensor is not None, 'a device is open'
            self.sensor = replace(self.sensor, rate_hz=self._rate.used_hz)
            self._stamper.restart(1e9 / self._rate.used_hz)
        if new.any():
            volts = np.array([values[axis][new] for axis in self._declared.axes]).T
            references = {
                column: values[role][new] for role, column in COLUMNS.items() if role in values
            }
            self._stamper.add(stamping.Block(device_ns[new], volts, references), arrived_ns)


class _ReadError(Exception):
    """The device is absent or lost; another attempt may find it."""


class _Column:
    """A channel, with the conversion of its codes to V or degC."""

    def __init__(self, role: str, channel: Any, sensor: Sensor, supply_scale: float) -> None:
        form = channel.data_format
        kind = channel.type.name
        if form.repeat > 1 or form.length not in (8, 16, 32, 64):
            raise UserError(
                f'{channel.id}: a format of {form.length} bits, {form.repeat} times, '
                'cannot be read'
            )
        self.role = role
        self.channel = channel
        self._dtype = f'{"i" if form.is_signed else "u"}{form.length // 8}'
        # The kernel omits an offset of 0, but never a scale. IIO scales to mV and m°C.
        self._offset = _number(channel, 'offset') if 'offset' in channel.attrs else 0.0
        self._scale = 1e-3 * _number(channel, 'scale')
        self._zero = 0.0
        if kind == 'IIO_ACCEL' and role in sensor.axes:
            # A digital sensor in m/s²: pseudo-volts by the nominal scale factor and zero-g.
            axis = sensor.axes.index(role)
            self._scale *= 1e3 / G0_MPS2 * float(sensor.nominal_scale_v_per_g[axis])
            self._zero = float(sensor.nominal_zero_g_v[axis])
        elif kind != ('IIO_TEMP' if role == TEMPERATURE else 'IIO_VOLTAGE'):
            raise UserError(f'link.channels: {channel.id} cannot be {role}: it is {kind}')
        elif role == SUPPLY:
            self._scale *= supply_scale
        # The ADC as fields of a sensor; 0 bits where the codes do not begin at 0 V
        bits = int(form.bits - form.is_signed)
        self.adc: dict[str, float] = (
            {'adc_bits': 0}
            if self._zero or self._offset
            else {'adc_bits': bits, 'adc_vref_v': self._scale * 2.0**bits}
        )

    def read(self, buffer: Any) -> np.ndarray:
        """Return V or degC for the codes of a buffer, (n,)."""
        codes = np.frombuffer(self.channel.read(buffer), self._dtype)
        return (codes + self._offset) * self._scale + self._zero


class _Stream:
    """
    A device whose buffer is running.

    adc: its sample rate and ADC, as fields of a sensor; by_host_clock: whether its time stamps are
    those of this machine's monotonic clock; buffer_s: duration of a buffer, s.
    """

    def __init__(
        self,
        context: Any,
        device: Any,
        columns: Sequence[_Column],
        settings: Settings,
        sensor: Sensor,
    ) -> None:
        self.name = _name(device)
        self._context = context
        self._device = device
        self._timestamp = device.find_channel('timestamp')
        if self._timestamp is None or not self._timestamp.scan_element:
            raise UserError(
                f'{self.name} has no channel timestamp: without it lost samples cannot be counted'
            )
        self.by_host_clock = _select_monotonic_clock(device) and settings.uri.startswith('local:')
        axis = next(column for column in columns if column.role in sensor.axes)
        self.rate_hz = rate_hz = _set_rate(context, device, columns, sensor.rate_hz)
        self.adc = {'rate_hz': rate_hz, **axis.adc}
        count = min(
            max(
                settings.samples_together(rate_hz),
                ceil(_ROUND_TRIPS * _answer_s(axis.channel) * rate_hz),
            ),
            _MAX_BUFFER,
        )
        self.buffer_s = count / rate_hz
        self._columns = [*columns]
        for channel in [self._timestamp, *(column.channel for column in self._columns)]:
            channel.enabled = True
        # Some kernels cannot set this number; a network server cannot once its buffer runs.
        with suppress(OSError):
            device.set_kernel_buffers_count(
                min(max(ceil(_KEPT_S / self.buffer_s), _MIN_KERNEL_BUFFERS), _MAX_KERNEL_BUFFERS)
            )
        context.set_timeout(round((_TIMEOUT_S + 2 * self.buffer_s) * 1000))
        self._buffer = import_libiio().Buffer(device, count)

    def read(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Wait for a buffer; return device times, ns, (n,), and V or degC by role, (n,) each."""
        try:
            self._buffer.refill()
            device_ns = np.frombuffer(self._timestamp.read(self._buffer), np.int64)
            values = {column.role: column.read(self._buffer) for column in self._columns}
        except OSError as error:
            raise _ReadError(f'{self.name}: lost: {reason(error)}') from None
        lengths = {len(device_ns), *map(len, values.values())}
        if (
            len(lengths) != 1
            or not len(device_ns)
            or not all(0 <= stamp_ns < _MAX_STAMP_NS for stamp_ns in device_ns.tolist())
        ):
            raise _ReadError(f'{self.name}: a buffer that makes no sense')
        return device_ns, values

    def close(self) -> None:
        """Delete buffer, channels, device and context in this order; libiio crashes in others."""
        self._buffer = None
        self._timestamp = None
        self._columns.clear()
        self._device = None
        self._context = None


def _open_stream(settings: Settings, entries: Sequence[str], sensor: Sensor) -> _Stream:
    iio = import_libiio()
    try:
        with _quiet_stderr():
            context = iio.Context(settings.uri)
    except (OSError, ValueError) as error:
        raise _ReadError(reason(error)) from None
    try:
        device = _find_device(context, settings.device)
        columns = [
            _Column(role, channel, sensor, settings.supply_scale)
            for role, channel in _assign_roles(device, entries, sensor.axes).items()
        ]
        return _Stream(context, device, columns, settings, sensor)
    except (OSError, ValueError) as error:
        raise _ReadError(f'{settings.device}: cannot be read: {reason(error)}') from None


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Drop what libiio itself writes to stderr: each attempt would write the same line."""
    original = os.dup(2)
    nothing = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(original, 2)
        os.close(original)
        os.close(nothing)


def _name(device: Any) -> str:
    return device.name or device.id


def _find_device(context: Any, name: str) -> Any:
    """Return the device with a name, id or label, or the only buffered one."""
    device = context.find_device(name) if name and name.isascii() else None
    if device is not None:
        return device
    buffered = [device for device in context.devices if _inputs(device)]
    if not name and len(buffered) == 1:
        return buffered[0]
    raise UserError(
        f'link.device: {name!r} is not there; with buffered channels there are: '
        f'{", ".join(map(_name, buffered)) or "none"}'
    )


def _inputs(device: Any) -> list[Any]:
    return [
        channel
        for channel in device.channels
        if channel.scan_element and not channel.output and channel.id != 'timestamp'
    ]


def _assign_roles(device: Any, entries: Sequence[str], axes: str) -> dict[str, Any]:
    """Return the channels of a device by role."""
    inputs = _inputs(device)
    order = [*axes, SUPPLY, TEMPERATURE]
    named: dict[str, Any] = {}
    for channel in reversed(inputs):
        names = channel.name, _label(channel), channel.id
        named |= dict.fromkeys(filter(None, names), channel)
    if not entries and set(axes) <= set(named):
        entries = [role for role in order if role in named]
    elif not entries:
        measured = [
            channel for channel in inputs if channel.type.name in ('IIO_VOLTAGE', 'IIO_ACCEL')
        ]
        entries = [
            channel.id
            for channel in sorted(measured, key=lambda channel: channel.index)[: len(axes)]
        ]
    assigned: list[tuple[str, Any]] = []
    for entry in entries:
        role, _, name = entry.rpartition('=')
        if name not in named:
            raise UserError(
                f'link.channels: {_name(device)} has no channel {name!r}; it has '
                f'{", ".join(channel.id for channel in inputs)} in its buffer'
            )
        free = [candidate for candidate in order if candidate not in dict(assigned)]
        role = role or (name if name in free or not free else free[0])
        assigned.append((role, named[name]))
    check_roles([role for role, _ in assigned], axes)
    return dict(assigned)


def _label(channel: Any) -> str:
    """Return the label of a channel; '' without one."""
    with suppress(OSError, KeyError):
        return channel.attrs['label'].value.strip()
    return ''


def _number(channel: Any, name: str) -> float:
    text = 'missing'
    with suppress(KeyError, OSError, ValueError):
        text = channel.attrs[name].value
        if isfinite(float(text)):
            return float(text)
    raise UserError(f'{channel.id}: its attribute {name} is {text!r}, not a number')


def _answer_s(channel: Any) -> float:
    """Return how long a device takes for an answer, s: to what the scale of a channel is."""
    began_s = time.perf_counter()
    for _ in range(_ANSWERS):
        _number(channel, 'scale')
    return (time.perf_counter() - began_s) / _ANSWERS


def _select_monotonic_clock(device: Any) -> bool:
    """Select time stamps of the monotonic clock; return whether the device has them."""
    attribute = device.attrs.get(_CLOCK_ATTRIBUTE)
    if attribute is None:
        return False
    with suppress(OSError):
        attribute.value = 'monotonic'
    return attribute.value.strip() == 'monotonic'


def _set_rate(context: Any, device: Any, columns: Sequence[_Column], rate_hz: float) -> float:
    """Set the sample rate of device, channel or only trigger; return the rate that it states."""
    triggers = [d for d in context.devices if isinstance(d, import_libiio().Trigger)]
    places = [device, *(column.channel for column in columns)]
    places += triggers if len(triggers) == 1 else []
    attributes = [
        place.attrs['sampling_frequency']
        for place in places
        if 'sampling_frequency' in place.attrs
    ]
    if not attributes:
        return rate_hz
    with suppress(OSError):
        attributes[0].value = f'{rate_hz:g}'
    text = attributes[0].value
    with suppress(ValueError):
        if RATES_HZ[0] <= float(text) <= RATES_HZ[1]:
            return float(text)
    raise UserError(f'{_name(device)}: its sampling_frequency is {text!r}')


def import_libiio() -> Any:
    """Return the module iio; raises `UserError` where it, or libiio, is not installed."""
    try:
        import iio
    except (ImportError, OSError, AttributeError):
        raise UserError(_INSTALL) from None
    return iio
