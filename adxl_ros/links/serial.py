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

"""A microcontroller with an ADC on a serial port, in wire format 1."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
import time
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.links.support import channels
from adxl_ros.links.support.base import nothing, Option, Samples, State
from adxl_ros.links.support.clock_sync import ClockMap
from adxl_ros.links.support.frame_counter import Count
from adxl_ros.links.support.sample_stamps import Block, Timeline
from adxl_ros.links.support.serial_port import Port, SILENT
from adxl_ros.links.support.wire_format import (
    AFTER_RESET,
    Data,
    decode,
    Info,
    library,
    Splitter,
    VersionError,
    WireError,
)
from adxl_ros.model.constants import AXES
from adxl_ros.model.sensor import Sensor
import numpy as np

OPTIONS = (
    Option('port', '', 'device path, such as /dev/ttyACM0, or a pyserial URL'),
    Option('baud', 115200, 'of a UART; USB and network ports ignore it', 'Bd', 50, 100_000_000),
    Option('channels', (), 'what the channels of a frame are, among x, y, z, supply, temperature '
           'and - (unused); empty: x, y, z, supply, the first ones'),
    Option('delay', 0.0, 'what the link takes at least from a sample to its arrival', 's',
           0.0, 1.0),
    channels.SUPPLY_SCALE,
    Option('temperature_zero_v', 0.5, 'output of the temperature sensor at 0 degC', 'V',
           -10.0, 10.0),
    Option('temperature_v_per_c', 0.01, 'its slope', 'V/degC', -10.0, 10.0),
)

_USUAL = (*AXES, channels.SUPPLY)
_SILENT_S = 0.5
_DEAF_S = 1.0
"""Bytes without a frame for so long are not those of a board at this rate."""
_INFORMED_S = 1.5
"""A board that has just been opened says what it is within this."""
_CONNECTING = 'connecting'
_BYTES_PER_S = 4e6
_FASTER = 20.0
"""Samples are taken at so many times their stated rate at most; the rest waits, or is the
device's loss: nobody can keep this node busy, or fill its memory."""
_CREDIT_S = 0.2


def open_link(sensor: Sensor, options: Mapping[str, Any]) -> SerialLink:
    """Check the options; the port is opened, and reopened for ever, by reading."""
    if not options['port']:
        raise UserError('link.port: names no port; set it to a device path or a pyserial URL')
    if not options['temperature_v_per_c']:
        raise UserError('link.temperature_v_per_c: 0 tells no temperature')
    library()
    return SerialLink(sensor, options)


class SerialLink:
    """
    The samples of a board, each once and in order, stamped by the board's clock.

    Whatever comes is skipped up to the next whole frame; what is lost is counted by the board's
    own numbers.
    """

    live = True
    waits = False
    start_ns = None
    sensor: Sensor | None = None

    def __init__(self, sensor: Sensor, options: Mapping[str, Any]) -> None:
        """Take what `OPTIONS` describe."""
        self._unit, self._options = sensor, options
        self._roles = channels.listed(options['channels'])
        if self._roles:
            channels.check_roles(self._roles, sensor.axes)
        self.references = channels.references_of(self._roles or _USUAL)
        self._port = Port(options['port'], options['baud'])
        self._splitter = Splitter()
        self._frames: deque[tuple[Info | Data, int]] = deque()
        self._info: Info | None = None
        self._refusal = self._version = ''
        self._count = Count()
        self._timeline = Timeline(ClockMap(options['delay']))
        self._good = self._bad = self._held_back = self._resets = self._rail = 0
        self._good_s = self._began_s = time.monotonic()
        self._longest_s = 0.0
        self._busy_s = 0.0

    def begin(self, now_ns: int) -> int:
        """Nothing is lost by a beginning: what was sent before is nobody's."""
        return 0

    def read(self, now_ns: int) -> Samples:
        """Wait for bytes, 50 ms at most, and return the samples that they complete."""
        if not self._frames:
            self._receive()
        while self._frames:
            frame, arrived_ns = self._frames[0]
            if isinstance(frame, Info) and frame != self._info:
                self._timeline.flush()
                if self._timeline.waiting:
                    break  # these have the figures of the board before
            self._frames.popleft()
            if isinstance(frame, Info):
                self._on_info(frame)
            else:
                self._on_data(frame, arrived_ns)
        samples = self._timeline.take()
        return nothing(self._unit, time.time_ns()) if samples is None else samples

    def state(self) -> State:
        """Say how the port, the frames and the clock are."""
        level, text = self._condition()
        return State(level, text, {
            'frames': self._good, 'bad_frames': self._bad,
            'bytes': self._port.received, 'skipped_bytes': self._splitter.skipped,
            'held_back': self._held_back, 'repeated': self._count.repeated,
            'device_overruns': self._count.overruns, 'rail_frames': self._rail,
            'resets': self._resets, 'connections': self._port.opened,
            **self._timeline.values()})

    def close(self) -> None:
        """Let go of the port."""
        self._port.close()

    def _condition(self) -> tuple[str, str]:
        now_s = time.monotonic()
        if self._port.trouble:
            return 'error', self._port.trouble
        if self._version:
            return 'error', self._version
        if self._info is None and now_s - max(self._port.opened_s, self._began_s) < _INFORMED_S:
            return 'ok', _CONNECTING
        name = self._options['port']
        silent_s = now_s - max(self._port.heard_s, self._began_s)
        if silent_s > max(_SILENT_S, 3 * self._longest_s):
            return 'warn', f'{name}: {SILENT}'
        if now_s - self._good_s > max(_DEAF_S, 3 * self._longest_s):
            return 'warn', (f'{name}: bytes, but no frame of wire format 1: is link.baud '
                            f'({self._options["baud"]}) that of the board?')
        if self._refusal:
            return 'error', self._refusal
        if self._info is None:
            return 'warn', f'{name}: waiting for the info frame of the board'
        return 'ok', self._streaming()

    def _streaming(self) -> str:
        assert self._info is not None
        unused = [] if self._roles else \
            [axis for axis in AXES[:self._info.channels] if axis not in self._unit.axes]
        if unused:
            return (f'streaming; the channel of {", ".join(unused)} is not used: sensor.axes is '
                    f'{self._unit.axes} (link.channels can say that it is the supply)')
        return 'streaming'

    def _receive(self) -> None:
        chunk = self._port.read()
        if chunk is None:
            # Another beginning: what had begun does not go on, and it may be another board.
            self._splitter.restart()
            self._count.reopened()
            return
        arrived_ns = time.monotonic_ns()
        samples = 0
        for raw in self._splitter(chunk):
            try:
                frame = decode(raw)
            except VersionError as error:
                self._version = (f'{self._options["port"]}: the board speaks {error}, this '
                                 'driver reads 1; use the firmware of this version')
                continue
            except WireError:
                self._bad += 1
                continue
            self._version = ''
            self._good += 1
            self._good_s = time.monotonic()
            self._port.worked()
            samples += len(frame.codes) if isinstance(frame, Data) else 1
            self._frames.append((frame, arrived_ns))
        self._brake(len(chunk), samples)

    def _brake(self, size: int, samples: int) -> None:
        """Take no more than what a board can mean; the rest stays where it is."""
        rate_hz = self._info.rate_hz if self._info else 1000.0
        now_s = time.monotonic()
        cost_s = size / _BYTES_PER_S + samples / (_FASTER * rate_hz)
        self._busy_s = max(self._busy_s, now_s - _CREDIT_S) + cost_s
        if self._busy_s > now_s:
            time.sleep(min(self._busy_s - now_s, 0.05))

    def _on_info(self, info: Info) -> None:
        reset = bool(info.flags & AFTER_RESET)
        if info == self._info and not reset:
            return
        changed = info != self._info
        self._info = info
        self._count.restart(info.rate_hz)
        self._refusal = ''
        try:
            roles = self._roles or list(_USUAL[:info.channels])
            if len(roles) > info.channels:
                raise UserError(f'link.channels: {len(roles)} are named, the board has '
                                f'{info.channels}')
            channels.check_roles([role for role in roles if self._roles or role not in AXES
                                  or role in self._unit.axes], self._unit.axes)
        except UserError as error:
            self._refusal = str(error)
        if changed and not self._refusal:
            self.sensor = replace(self._unit, rate_hz=info.rate_hz, adc_bits=info.bits,
                                  adc_vref_v=info.vref_v, serial=info.serial or self._unit.serial)

    def _on_data(self, data: Data, arrived_ns: int) -> None:
        info = self._info
        self._longest_s = len(data.codes) / (info.rate_hz if info else 1000.0)
        if info is None or self._refusal:
            self._held_back += len(data.codes)
            return
        if data.codes.shape[1] != info.channels or data.codes.max() >= 2 ** info.bits:
            self._bad += 1  # whole, but not what the info frame says
            return
        for found in self._count(data, arrived_ns):
            if found.lost is None:
                self._resets += self._timeline.period_ns > 0
                self._timeline.restart(1e9 / info.rate_hz)
            elif found.stepped:
                self._timeline.step()
            self._timeline.put(self._block(found.data, info), arrived_ns, found.lost or 0)

    def _block(self, data: Data, info: Info) -> Block:
        self._rail += data.flags & 1
        roles = self._roles or _USUAL[:info.channels]
        volts = data.codes * (info.vref_v / 2 ** info.bits)
        values = {role: volts[:, i] for i, role in enumerate(roles)}
        if channels.TEMPERATURE in values:
            values[channels.TEMPERATURE] = (
                values[channels.TEMPERATURE] - self._options['temperature_zero_v']
            ) / self._options['temperature_v_per_c']
        steps = np.arange(len(volts)) * (1e9 / info.rate_hz)
        device_ns = data.time_us * 1000 + np.rint(steps).astype(np.int64)
        return Block(device_ns, *channels.split(values, self._unit, self.references,
                                                self._options['supply_scale']))
