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

"""One IIO device, opened: its channels chosen, its figures read, its buffer running."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import isfinite
import os
import socket
import time
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.links.support import channels
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
import numpy as np

_KERNEL_BUFFERS = 16
_BLOCK_S = 0.02
_MOST_SAMPLES = 2000
_PATIENCE_S = 1.0
"""A buffer that is late by this will not come: a server that was killed or stopped."""
_PORT = '30431'
_KNOCK_S = 0.5
_SLOW_S = 1.0
"""Attributes, such as a temperature without a buffer, are read this often."""
_CLOCK = 'current_timestamp_clock'
_LAST_NS = 2 ** 62
_INSTALL = ('link.type iio needs the Python package pylibiio and the library libiio 0.x: '
            'pip install "pylibiio<1", apt install libiio0')


class ReadError(Exception):
    """The device is not there, or is there no more; another try may find it."""


@dataclass(frozen=True)
class _Column:
    """A channel with what turns its codes into V, or degC: (code + offset) * scale + zero."""

    role: str
    channel: Any
    dtype: str
    offset: float
    scale: float
    zero: float = 0.0

    def convert(self, codes: np.ndarray) -> np.ndarray:
        return (codes + self.offset) * self.scale + self.zero


class Stream:
    """
    A running buffer.

    Attributes
    ----------
    name
        Of the device.
    figures : mapping
        What the device says of the sensor's ADC, by the fields of `Sensor`.
    by_host_clock
        Whether its time stamps are those of this machine's monotonic clock.
    block_s
        How long a buffer takes, s.
    about
        What is read, in a few words.

    """

    def __init__(self, context: Any, device: Any, columns: Sequence[_Column],
                 polled: Sequence[_Column], timestamp: Any, rate_hz: float) -> None:
        """Start the buffer; raises OSError."""
        self.name = device.name or device.id
        count = int(min(max(rate_hz * _BLOCK_S, 1), _MOST_SAMPLES))
        self.block_s = count / rate_hz
        self._context, self._device, self._timestamp = context, device, timestamp
        self._columns, self._polled = list(columns), list(polled)
        self._polled_s = 0.0
        for channel in [timestamp, *(c.channel for c in columns)]:
            channel.enabled = True
        # Some kernels, and every network server that is asked too late, have no say in this.
        with suppress(OSError):
            device.set_kernel_buffers_count(_KERNEL_BUFFERS)
        context.set_timeout(round((_PATIENCE_S + 2 * self.block_s) * 1000))
        self._buffer = library().Buffer(device, count)

    def read(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """
        Wait for a buffer.

        Returns
        -------
        tuple
            Device times, ns, (n,) int64, and by role V or degC, (n,).

        Raises
        ------
        ReadError
            The device is gone, or silent for longer than its buffer takes.

        """
        try:
            self._buffer.refill()
            device_ns = np.frombuffer(self._timestamp.read(self._buffer), np.int64)
            values = {c.role: c.convert(np.frombuffer(c.channel.read(self._buffer), c.dtype))
                      for c in self._columns}
            values |= self._poll(len(device_ns))
        except OSError as error:
            raise ReadError(f'{self.name}: lost: {_words(error)}') from None
        lengths = {len(device_ns), *map(len, values.values())}
        if len(lengths) != 1 or not len(device_ns) or not (
                device_ns.min() >= 0 and device_ns.max() < _LAST_NS):
            raise ReadError(f'{self.name}: a buffer that makes no sense')
        return device_ns, values

    def _poll(self, count: int) -> dict[str, np.ndarray]:
        """Read what has no place in the buffer once in a while; NaN in between."""
        values = {c.role: np.full(count, np.nan) for c in self._polled}
        if self._polled and time.monotonic() - self._polled_s >= _SLOW_S:
            self._polled_s = time.monotonic()
            for column in self._polled:
                values[column.role][:] = column.convert(_number(column.channel, 'raw'))
        return values

    def close(self) -> None:
        """Let go in the order that libiio survives: buffer, channels, device, context."""
        self._buffer = None
        self._timestamp = None
        self._columns.clear()
        self._polled.clear()
        self._device = None
        self._context = None


def open_stream(uri: str, name: str, entries: Sequence[str], sensor: Sensor) -> Stream:
    """
    Open a device and start its buffer.

    Parameters
    ----------
    uri, name, entries
        As the driver's parameters `link.uri`, `link.device`, `link.channels` have them.
    sensor
        Whose axes are wanted, and at what rate.

    Raises
    ------
    ReadError
        It is not there.
    UserError
        It is there, but not as the parameters say.

    """
    iio = library()
    try:
        _knock(uri)
        context = iio.Context(uri)
    except (OSError, ValueError) as error:
        raise ReadError(_words(error)) from None
    try:
        device = _device(context, name)
        chosen = _chosen(device, entries, sensor.axes)
        columns = [_column(role, channel, sensor) for role, channel in chosen.items()]
        timestamp = device.find_channel('timestamp')
        if timestamp is None or not timestamp.scan_element:
            raise UserError(f'{device.name or device.id} has no channel timestamp: without it '
                            'nobody can tell which samples are lost')
        by_host_clock = _use_monotonic_clock(device) and uri.startswith('local:')
        rate_hz = _set_rate(context, device, [c.channel for c in columns], sensor.rate_hz)
        stream = Stream(context, device, [c for c in columns if c.channel.scan_element],
                        [c for c in columns if not c.channel.scan_element], timestamp, rate_hz)
    except (OSError, ValueError) as error:
        raise ReadError(f'{name}: cannot be read: {_words(error)}') from None
    stream.by_host_clock = by_host_clock
    stream.figures = {'rate_hz': rate_hz, **_adc(columns[0])}
    asked = '' if abs(rate_hz / sensor.rate_hz - 1) < 1e-3 else \
        f' ({sensor.rate_hz:g} Hz were asked for)'
    stream.about = f'streaming at {rate_hz:g} Hz{asked}'
    return stream


def _knock(uri: str) -> None:
    """
    See whether an iiod answers, before libiio waits five seconds for one that does not.

    Raises
    ------
    OSError
        It does not.
    ValueError
        The port is no number.

    """
    kind, _, address = uri.partition(':')
    if kind != 'ip':
        return
    host, colon, port = address.rpartition(':')
    if not colon or (':' in host and not host.endswith(']')):
        host, port = address, _PORT
    with socket.create_connection((host.strip('[]'), int(port)), _KNOCK_S) as knock:
        knock.sendall(b'VERSION\r\n')
        if not knock.recv(64):
            raise OSError('the other side has closed')


def _device(context: Any, name: str) -> Any:
    """Find a device by name, id or label, or the only one."""
    if name:
        found = context.find_device(name) if name.isascii() else None
        if found is not None:
            return found
    able = [d for d in context.devices if any(
        c.scan_element and not c.output and c.id != 'timestamp' for c in d.channels)]
    if not name and len(able) == 1:
        return able[0]
    there = ', '.join(d.name or d.id for d in able) or 'none'
    raise UserError(f'link.device: {name!r} is not there; with buffered channels there are: '
                    f'{there}')


def _chosen(device: Any, entries: Sequence[str], axes: str) -> dict[str, Any]:
    """Return the channels by role."""
    inputs = [c for c in device.channels if not c.output and c.id != 'timestamp']
    labels = {c.id: _label(c) for c in inputs}
    usual = [*axes, channels.SUPPLY, channels.TEMPERATURE]
    if not entries:
        by_label = {labels[c.id]: c for c in inputs}
        if all(axis in by_label for axis in axes):
            return {role: by_label[role] for role in usual if role in by_label}
        plain = sorted((c for c in inputs if c.scan_element
                        and c.type.name in ('IIO_VOLTAGE', 'IIO_ACCEL')), key=lambda c: c.index)
        entries = [c.id for c in plain[:len(axes)]]
    chosen: dict[str, Any] = {}
    for entry in entries:
        role, equals, wanted = entry.rpartition('=')
        channel = next((c for c in inputs if wanted in (c.id, labels[c.id], c.name)), None)
        if channel is None:
            there = ', '.join(f'{c.id} ({labels[c.id]})' if labels[c.id] else c.id
                              for c in inputs)
            raise UserError(f'link.channels: {device.name or device.id} has no channel '
                            f'{wanted!r}; it has {there}')
        if not equals:
            free = [r for r in usual if r not in chosen]
            role = wanted if wanted in free else next(iter(free), wanted)
        chosen[role] = channel
    channels.check_roles(list(chosen), axes)
    for role, channel in chosen.items():
        if role in axes and not channel.scan_element:
            raise UserError(f'link.channels: {channel.id} has no place in the buffer')
    return chosen


def _label(channel: Any) -> str:
    with suppress(OSError, KeyError):
        return channel.attrs['label'].value.strip()
    return ''


def _column(role: str, channel: Any, sensor: Sensor) -> _Column:
    """Read how a channel's codes become V, or degC."""
    form = channel.data_format
    if channel.scan_element and (form.repeat > 1 or form.length not in (8, 16, 32, 64)):
        raise UserError(f'{channel.id}: a format of {form.length} bits, {form.repeat} times, '
                        'cannot be read')
    dtype = f'{"i" if form.is_signed else "u"}{form.length // 8}'
    # The kernel leaves an offset of 0 away; a scale it never does.
    offset = _number(channel, 'offset') if 'offset' in channel.attrs else 0.0
    scale = _number(channel, 'scale')
    kind = channel.type.name
    if kind == 'IIO_ACCEL' and role in sensor.axes:
        # A digital sensor: pseudo-volts by the nominal figures.
        axis = sensor.axes.index(role)
        return _Column(role, channel, dtype, offset,
                       scale / G0_MPS2 * float(sensor.nominal_scale_v_per_g[axis]),
                       float(sensor.nominal_zero_g_v[axis]))
    unit = 'IIO_TEMP' if role == channels.TEMPERATURE else 'IIO_VOLTAGE'
    if kind != unit:
        raise UserError(f'link.channels: {channel.id} cannot be {role}: it is {kind}')
    return _Column(role, channel, dtype, offset, scale * 1e-3)


def _number(channel: Any, name: str) -> float:
    """Read an attribute; one that cannot be read is an error, never a made-up number."""
    text = ''
    try:
        text = channel.attrs[name].value
        value = float(text)
    except KeyError:
        raise UserError(f'{channel.id} has no attribute {name}: its volts are not known'
                        ) from None
    except OSError as error:
        raise UserError(f'{channel.id}: its attribute {name} cannot be read: {_words(error)}'
                        ) from None
    except ValueError:
        value = float('nan')
    if not isfinite(value):
        raise UserError(f'{channel.id}: its attribute {name} is {text!r}, not a number')
    return value


def _use_monotonic_clock(device: Any) -> bool:
    """Ask for time stamps of the clock that nobody sets; tell whether they are."""
    attribute = device.attrs.get(_CLOCK)
    if attribute is None:
        return False
    with suppress(OSError):
        attribute.value = 'monotonic'
    return attribute.value.strip() == 'monotonic'


def _set_rate(context: Any, device: Any, chosen: Sequence[Any], rate_hz: float) -> float:
    """Set the sample rate wherever it is set, and return what holds then."""
    places: list[Mapping[str, Any]] = [device.attrs, *(c.attrs for c in chosen)]
    triggers = [d for d in context.devices if isinstance(d, library().Trigger)]
    places += [t.attrs for t in triggers if len(triggers) == 1]
    attribute = next((p['sampling_frequency'] for p in places if 'sampling_frequency' in p), None)
    if attribute is None:
        return rate_hz  # as declared by the parameters: the device has no say in it
    with suppress(OSError):
        attribute.value = f'{rate_hz:g}'
    text = attribute.value
    try:
        found = float(text)
    except ValueError:
        found = 0.0
    if not 0.01 <= found <= 1e5:
        raise UserError(f'{device.name or device.id}: its sampling_frequency is {text!r}')
    return found


def _adc(column: _Column) -> dict[str, Any]:
    """Return where the rails of the ADC are, as far as the figures of a sensor can say it."""
    form = column.channel.data_format
    if column.zero or column.offset:
        return {'adc_bits': 0}
    bits = form.bits - form.is_signed
    return {'adc_bits': int(bits), 'adc_vref_v': column.scale * 2.0 ** bits}


def _words(error: OSError | ValueError) -> str:
    code = getattr(error, 'errno', None)
    return os.strerror(abs(code)) if code else ' '.join(str(error).split())


def library() -> Any:
    """Return the module iio; raises `UserError` where it, or libiio, is not installed."""
    try:
        import iio
    except (ImportError, OSError, AttributeError):
        raise UserError(_INSTALL) from None
    return iio
