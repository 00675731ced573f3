# SPDX-License-Identifier: Apache-2.0

"""A buffered IIO device through libiio: its channels, their conversion to volts, its samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from math import ceil, isfinite
import os
import socket
import time
from typing import Any, NamedTuple

from adxl_ros.errors import install_hint, UserError
from adxl_ros.links.support import channels
from adxl_ros.links.support.base import LatencySettings
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
import numpy as np

_KEPT_S = 0.32
"""Duration of the samples that the kernel keeps while nobody reads, s; chosen: a busy machine
delays a read by less."""
_MIN_KERNEL_BUFFERS = 4
"""Fewest buffers of the kernel, the default of libiio."""
_MAX_KERNEL_BUFFERS = 320
"""Most buffers of the kernel; chosen: single samples at 1 kHz are kept as long as others, and its
memory has a bound at high rates."""
_ANSWERS = 20
"""Answers of a device that are timed when it is opened."""
_ROUND_TRIPS = 4.0
"""Shortest duration of a buffer by the mean time of an answer. Chosen: each buffer needs one,
so that the reads catch up with four times the sample rate after a delay."""
_MAX_BUFFER = 2000
"""Most samples of a buffer."""
_TIMEOUT_S = 1.0
"""Lateness after which a buffer will not come, s: the server was killed or stopped."""
_IIOD_PORT = '30431'
"""TCP port of iiod without another one in the URI."""
_PROBE_S = 0.5
"""Longest wait for the answer of an iiod, s; libiio itself waits for five seconds."""
_POLL_S = 1.0
"""Period in which attributes are read that have no place in the buffer, s."""
_CLOCK_ATTRIBUTE = 'current_timestamp_clock'
"""Attribute of the kernel that selects the clock of the time stamps."""
_MAX_STAMP_NS = 2 ** 62
"""Largest plausible time stamp, ns."""
_MIN_RATE_HZ = 0.01
"""Smallest sample rate, Hz, as `sensor.rate_hz` permits."""
_MAX_RATE_HZ = 1e5
"""Largest sample rate, Hz, as `sensor.rate_hz` permits."""
_INSTALL = ('link.type iio needs the Python package pylibiio and the library libiio 0.x: '
            f'{install_hint("pylibiio<1")} and sudo apt install libiio0')
"""What a user is told where libiio is not installed."""


class ReadError(Exception):
    """The device is absent or lost; another attempt may find it."""


@dataclass(frozen=True)
class AdcInfo:
    """What a device states about its ADC."""

    rate_hz: float  # Sample rate, Hz
    bits: int  # Resolution, bit; 0 where the codes do not begin at 0 V
    vref_v: float | None = None  # Full scale, V; None where it is not known

    def apply(self, sensor: Sensor) -> Sensor:
        """Return a sensor with this ADC."""
        vref_v = sensor.adc_vref_v if self.vref_v is None else self.vref_v
        return replace(sensor, rate_hz=self.rate_hz, adc_bits=self.bits, adc_vref_v=vref_v)


class BufferSamples(NamedTuple):
    """Device times, ns, (n,) int64, and V or degC by role, (n,) each."""

    device_ns: np.ndarray
    values: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class _Column:
    """A channel, with the conversion of its codes to V or degC: (code + offset) * scale + zero."""

    role: str  # Role of the channel
    channel: Any  # The channel of libiio
    dtype: str  # numpy type of its codes
    offset: float  # Offset, in codes
    scale: float  # Scale, V or degC per code
    zero: float = 0.0  # Zero-g of a digital sensor's pseudo-volts, V

    @property
    def buffered(self) -> bool:
        """Whether the channel has a place in the buffer."""
        return bool(self.channel.scan_element)

    def convert(self, codes: Any) -> Any:
        """Return V or degC for a code or an array of codes."""
        return (codes + self.offset) * self.scale + self.zero

    def adc(self, rate_hz: float) -> AdcInfo:
        """Return the ADC of this channel, as far as the format determines it."""
        if self.zero or self.offset:
            return AdcInfo(rate_hz, 0)
        form = self.channel.data_format
        bits = int(form.bits - form.is_signed)
        return AdcInfo(rate_hz, bits, self.scale * 2.0 ** bits)


class Stream:
    """
    A device whose buffer is running.

    name: name of the device; adc: its ADC; by_host_clock: whether its time stamps are those of
    this machine's monotonic clock.
    """

    def __init__(self, context: Any, device: Any, columns: Sequence[_Column], timestamp: Any,
                 adc: AdcInfo, by_host_clock: bool, latency: LatencySettings) -> None:
        """Start the buffer."""
        self.name, self.adc, self.by_host_clock = device.name or device.id, adc, by_host_clock
        count = max(latency.samples_together(adc.rate_hz),
                    ceil(_ROUND_TRIPS * _answer_s(columns[0].channel) * adc.rate_hz))
        count = min(count, _MAX_BUFFER)
        self.buffer_s = count / adc.rate_hz  # Duration of a buffer, s
        self._context, self._device, self._timestamp = context, device, timestamp
        self._columns = [column for column in columns if column.buffered]
        self._polled = [column for column in columns if not column.buffered]
        self._polled_s = 0.0
        for channel in [timestamp, *(column.channel for column in self._columns)]:
            channel.enabled = True
        # Some kernels cannot set this number; a network server cannot once its buffer runs.
        with suppress(OSError):
            device.set_kernel_buffers_count(
                min(max(ceil(_KEPT_S / self.buffer_s), _MIN_KERNEL_BUFFERS), _MAX_KERNEL_BUFFERS))
        context.set_timeout(round((_TIMEOUT_S + 2 * self.buffer_s) * 1000))
        self._buffer = import_libiio().Buffer(device, count)

    def read(self) -> BufferSamples:
        """Wait for a buffer."""
        try:
            self._buffer.refill()
            device_ns = np.frombuffer(self._timestamp.read(self._buffer), np.int64)
            values = {column.role: column.convert(np.frombuffer(
                column.channel.read(self._buffer), column.dtype)) for column in self._columns}
            values |= self._poll(len(device_ns))
        except OSError as error:
            raise ReadError(f'{self.name}: lost: {_reason(error)}') from None
        lengths = {len(device_ns), *map(len, values.values())}
        if len(lengths) != 1 or not len(device_ns) or not all(
                0 <= stamp_ns < _MAX_STAMP_NS for stamp_ns in device_ns.tolist()):
            raise ReadError(f'{self.name}: a buffer that makes no sense')
        return BufferSamples(device_ns, values)

    def close(self) -> None:
        """Delete buffer, channels, device and context in this order; libiio crashes in others."""
        self._buffer = None
        self._timestamp = None
        self._columns.clear()
        self._polled.clear()
        self._device = None
        self._context = None

    def _poll(self, count: int) -> dict[str, np.ndarray]:
        """Read the channels without a place in the buffer once a second; NaN in between."""
        values = {column.role: np.full(count, np.nan) for column in self._polled}
        if self._polled and time.monotonic() - self._polled_s >= _POLL_S:
            self._polled_s = time.monotonic()
            for column in self._polled:
                values[column.role][:] = column.convert(_number(column.channel, 'raw'))
        return values


def open_stream(uri: str, device_name: str, entries: Sequence[str], sensor: Sensor,
                latency: LatencySettings) -> Stream:
    """Open a device and start its buffer."""
    iio = import_libiio()
    try:
        _probe(uri)
        with _quiet_stderr():
            context = iio.Context(uri)
    except (OSError, ValueError) as error:
        raise ReadError(_reason(error)) from None
    try:
        device = _find_device(context, device_name)
        columns = [_column(assignment, sensor)
                   for assignment in _assign_roles(device, entries, sensor.axes)]
        timestamp = device.find_channel('timestamp')
        if timestamp is None or not timestamp.scan_element:
            raise UserError(f'{device.name or device.id} has no channel timestamp: without it '
                            'lost samples cannot be counted')
        by_host_clock = _select_monotonic_clock(device) and uri.startswith('local:')
        rate_hz = _set_rate(context, device, columns, sensor.rate_hz)
        return Stream(context, device, columns, timestamp, columns[0].adc(rate_hz), by_host_clock,
                      latency)
    except (OSError, ValueError) as error:
        raise ReadError(f'{device_name}: cannot be read: {_reason(error)}') from None


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Drop what libiio itself writes to stderr: each attempt would write the same line."""
    original, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(original, 2)
        os.close(original)
        os.close(nothing)


def _probe(uri: str) -> None:
    """Check that an iiod answers."""
    kind, _, address = uri.partition(':')
    if kind != 'ip':
        return
    host, colon, port = address.rpartition(':')
    if not colon or (':' in host and not host.endswith(']')):
        host, port = address, _IIOD_PORT
    with socket.create_connection((host.strip('[]'), int(port)), _PROBE_S) as connection:
        connection.sendall(b'VERSION\r\n')
        if not connection.recv(64):
            raise OSError('the other side has closed')


def _find_device(context: Any, name: str) -> Any:
    """Return the device with a name, id or label, or the only buffered one."""
    if name:
        device = context.find_device(name) if name.isascii() else None
        if device is not None:
            return device
    buffered = [device for device in context.devices if _has_buffer(device)]
    if not name and len(buffered) == 1:
        return buffered[0]
    names = ', '.join(device.name or device.id for device in buffered) or 'none'
    raise UserError(f'link.device: {name!r} is not there; with buffered channels there are: '
                    f'{names}')


def _has_buffer(device: Any) -> bool:
    return any(channel.scan_element for channel in _inputs(device))


def _inputs(device: Any) -> Iterator[Any]:
    """Yield the input channels of a device without its time stamps."""
    return (channel for channel in device.channels
            if not channel.output and channel.id != 'timestamp')


class _Assignment(NamedTuple):
    """A channel of libiio and its role."""

    role: str
    channel: Any


def _assign_roles(device: Any, entries: Sequence[str], axes: str) -> list[_Assignment]:
    """Assign the channels of a device to roles."""
    if not entries:
        labelled = _by_label(device, axes)
        if labelled:
            return labelled
        entries = [channel.id for channel in _first_measured(device, len(axes))]
    order = [*axes, channels.SUPPLY, channels.TEMPERATURE]
    assignments: list[_Assignment] = []
    for entry in entries:
        role, equals, name = entry.rpartition('=')
        channel = _find_channel(device, name)
        if not equals:
            assigned = [assignment.role for assignment in assignments]
            free = [candidate for candidate in order if candidate not in assigned]
            role = name if name in free else next(iter(free), name)
        assignments.append(_Assignment(role, channel))
    channels.check_roles([assignment.role for assignment in assignments], axes)
    for role, channel in assignments:
        if role in axes and not channel.scan_element:
            raise UserError(f'link.channels: {channel.id} has no place in the buffer')
    return assignments


def _by_label(device: Any, axes: str) -> list[_Assignment]:
    """Return the channels whose labels are roles; none unless every axis is labelled."""
    by_label = {_label(channel): channel for channel in _inputs(device)}
    if not all(axis in by_label for axis in axes):
        return []
    return [_Assignment(role, by_label[role])
            for role in (*axes, channels.SUPPLY, channels.TEMPERATURE) if role in by_label]


def _first_measured(device: Any, count: int) -> list[Any]:
    """Return the first buffered channels of voltage or acceleration."""
    measured = [channel for channel in _inputs(device) if channel.scan_element
                and channel.type.name in ('IIO_VOLTAGE', 'IIO_ACCEL')]
    return sorted(measured, key=lambda channel: channel.index)[:count]


def _find_channel(device: Any, name: str) -> Any:
    """Return the channel with an id, label or name; raises `UserError` without one."""
    labels = {channel.id: _label(channel) for channel in _inputs(device)}
    for channel in _inputs(device):
        if name in (channel.id, labels[channel.id], channel.name):
            return channel
    available = ', '.join(f'{key} ({label})' if label else key for key, label in labels.items())
    raise UserError(f'link.channels: {device.name or device.id} has no channel {name!r}; it has '
                    f'{available}')


def _label(channel: Any) -> str:
    """Return the label of a channel; '' without one."""
    with suppress(OSError, KeyError):
        return channel.attrs['label'].value.strip()
    return ''


def _column(assignment: _Assignment, sensor: Sensor) -> _Column:
    """Read how the codes of a channel become V or degC."""
    role, channel = assignment
    form = channel.data_format
    if channel.scan_element and (form.repeat > 1 or form.length not in (8, 16, 32, 64)):
        raise UserError(f'{channel.id}: a format of {form.length} bits, {form.repeat} times, '
                        'cannot be read')
    dtype = f'{"i" if form.is_signed else "u"}{form.length // 8}'
    # The kernel omits an offset of 0, but never a scale.
    offset = _number(channel, 'offset') if 'offset' in channel.attrs else 0.0
    scale = _number(channel, 'scale')
    kind = channel.type.name
    if kind == 'IIO_ACCEL' and role in sensor.axes:
        # A digital sensor in m/s²: pseudo-volts by the nominal scale factor and zero-g.
        axis = sensor.axes.index(role)
        return _Column(role, channel, dtype, offset,
                       scale / G0_MPS2 * float(sensor.nominal_scale_v_per_g[axis]),
                       float(sensor.nominal_zero_g_v[axis]))
    expected = 'IIO_TEMP' if role == channels.TEMPERATURE else 'IIO_VOLTAGE'
    if kind != expected:
        raise UserError(f'link.channels: {channel.id} cannot be {role}: it is {kind}')
    # IIO scales to mV and m°C.
    return _Column(role, channel, dtype, offset, scale * 1e-3)


def _number(channel: Any, name: str) -> float:
    """Read an attribute; raises `UserError` where it is not a finite number."""
    text = ''
    try:
        text = channel.attrs[name].value
        value = float(text)
    except KeyError:
        raise UserError(f'{channel.id} has no attribute {name}: its volts are not known'
                        ) from None
    except OSError as error:
        raise UserError(f'{channel.id}: its attribute {name} cannot be read: {_reason(error)}'
                        ) from None
    except ValueError:
        value = float('nan')
    if not isfinite(value):
        raise UserError(f'{channel.id}: its attribute {name} is {text!r}, not a number')
    return value


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
    """
    Set the sample rate of the device, of a channel or of the only trigger.

    returns: sample rate that the device states then, Hz; `rate_hz` where it states none.
    """
    triggers = [d for d in context.devices if isinstance(d, import_libiio().Trigger)]
    places = [device, *(column.channel for column in columns)]
    places += triggers if len(triggers) == 1 else []
    attributes = [place.attrs['sampling_frequency'] for place in places
                  if 'sampling_frequency' in place.attrs]
    if not attributes:
        return rate_hz
    with suppress(OSError):
        attributes[0].value = f'{rate_hz:g}'
    text = attributes[0].value
    try:
        stated_hz = float(text)
    except ValueError:
        stated_hz = 0.0
    if not _MIN_RATE_HZ <= stated_hz <= _MAX_RATE_HZ:
        raise UserError(f'{device.name or device.id}: its sampling_frequency is {text!r}')
    return stated_hz


def _reason(error: OSError | ValueError) -> str:
    """Return in one line why libiio failed; its error numbers may be negative."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(abs(error.errno))
    return ' '.join(str(error).split())


def import_libiio() -> Any:
    """Return the module iio; raises `UserError` where it, or libiio, is not installed."""
    try:
        import iio
    except (ImportError, OSError, AttributeError):
        raise UserError(_INSTALL) from None
    return iio
