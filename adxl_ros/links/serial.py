# SPDX-License-Identifier: Apache-2.0

"""A microcontroller with an ADC on a serial port, in wire format 1."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import time
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.links.support import channels
from adxl_ros.links.support.base import (
    DeviceSettings,
    Event,
    Level,
    LinkStatus,
    no_samples,
    option,
    Samples,
)
from adxl_ros.links.support.channels import clock_events, Stamper
from adxl_ros.links.support.clock_sync import ClockMap
from adxl_ros.links.support.serial_port import import_pyserial, SerialPort, SILENT
from adxl_ros.links.support.wire_format import (
    AFTER_RESET,
    BoardInfo,
    decode,
    encode_command,
    FrameCounter,
    MAX_COUNT,
    RAIL,
    SampleFrame,
    samples_that_fit,
    Splitter,
    VersionError,
    WireError,
)
from adxl_ros.model.constants import AXES
from adxl_ros.model.sensor import Sensor
import numpy as np

_DEFAULT_ROLES = (*AXES, channels.SUPPLY)
"""Roles of the first channels where the parameters state none."""
_SILENT_S = 0.5
"""Silence after which a board counts as silent, s. Chosen: 50 frames of the firmware."""
_NO_FRAME_S = 1.0
"""Time without a whole frame after which the bytes are not those of a board, s. Chosen: two
silences, so that silence is reported first."""
_INFO_WAIT_S = 1.5
"""Longest time without an info frame after opening, s. Derived: a board sends one each second."""
_COMMAND_PAUSE_S = 0.5
"""Shortest time between two commands, s. Chosen: a board has answered by then."""
_COMMANDS = 3
"""Commands that a board gets before it counts as one that does not obey. Chosen: noise may damage
one of them."""
_SILENT_FRAMES = 3
"""A board also counts as silent only after this many times its longest frame."""
_MAX_BYTES_PER_S = 4e6
"""Bytes that are read per second at most. Chosen: more than USB full speed carries."""
_MAX_RATE_RATIO = 20.0
"""Samples are read at this many times the stated rate at most. What comes faster waits in the
kernel or is lost there. So no device can keep the node busy or fill its memory."""
_CREDIT_S = 0.2
"""Reading time that a link saves up for a burst, s. Chosen: the backlog of a stall is read at
once."""
_MAX_PAUSE_S = 0.05
"""Longest pause of one read, s, so that the driver reacts to its end."""
_UNSTATED_RATE_HZ = 1000.0
"""Sample rate before the info frame, Hz: that of the firmware."""


@dataclass(frozen=True)
class Settings(DeviceSettings):
    """Settings of the link."""

    # Device path or pyserial URL
    port: str = option('', 'device path, such as /dev/ttyACM0, or a pyserial URL')
    # Baud rate of a UART, Bd
    baud: int = option(115200, 'baud rate of a UART; USB and network ports ignore it', 'Bd', 50,
                       100_000_000)
    # Roles of the channels of a frame: a list of strings, or one string with commas. Empty for x,
    # y, z, supply.
    channels: str | Sequence[str] = option(
        (), 'roles of the channels of a frame: x, y, z, supply, temperature, or - for unused; '
        'empty: the first channels are x, y, z, supply')
    # Output of the temperature sensor at 0 degC, V
    temperature_zero_v: float = option(0.5, 'output of the temperature sensor at 0 degC', 'V',
                                       -10.0, 10.0)
    # Slope of the temperature sensor, V/degC
    temperature_v_per_c: float = option(0.01, 'slope of the temperature sensor', 'V/degC',
                                        -10.0, 10.0)


@dataclass(frozen=True)
class Statistics:
    """Counts of the link, as diagnostics show them."""

    frames: int  # Whole frames
    bad_frames: int  # Frames that are damaged or contradict the info frame
    # Bytes received
    bytes: int  # noqa: A003
    skipped_bytes: int  # Bytes of runs that are too long for a frame
    # Samples that came before the board had described itself, or do not fit the sensor
    held_back: int
    repeated: int  # Samples of frames that came twice or late
    device_overruns: int  # Samples that the board itself dropped
    frame_ms: float  # Duration of the newest frame, ms: its first sample waited for as long
    rail_frames: int  # Frames with a code at a rail of the ADC
    resets: int  # How often a new count has begun
    connections: int  # How often the port was opened


@dataclass(frozen=True)
class _Conversion:
    """How the codes of a board become samples."""

    # gain, offset: Value of a channel is gain · code + offset, V or degC, (m,)
    gain: np.ndarray
    offset: np.ndarray
    axes: slice | list[int]  # Channels of the axes of the sensor
    # Channel of each reference by column; None where no channel has it
    reference_channels: Mapping[str, int | None]
    steps_ns: np.ndarray  # Times of the samples of a frame after its first one, ns, int64, (256,)
    max_code: int  # Largest code

    def block(self, frame: SampleFrame) -> channels.Block:
        """Return the samples of a frame."""
        values = frame.codes.astype(float)
        values *= self.gain
        values += self.offset
        references = {column: channels.absent(len(values)) if i is None else values[:, i]
                      for column, i in self.reference_channels.items()}
        return channels.Block(frame.time_us * 1000 + self.steps_ns[:len(values)],
                              values[:, self.axes], references)


class _Arrival(NamedTuple):
    """A decoded frame, and the monotonic time of its arrival, ns."""

    frame: BoardInfo | SampleFrame
    arrived_ns: int


def open_link(sensor: Sensor, settings: Settings) -> SerialLink:
    """Check the settings; `SerialLink.read` opens the port, and opens it again after each loss."""
    if not settings.port:
        raise UserError('link.port: names no port; set it to a device path or a pyserial URL')
    if not settings.temperature_v_per_c:
        raise UserError('link.temperature_v_per_c: is 0; set the slope of the temperature sensor')
    import_pyserial()
    return SerialLink(sensor, settings)


class SerialLink:
    """
    The samples of a board, each once and in order, stamped by the clock of the board.

    Bytes that are no whole frame are skipped. The numbers of the board show which samples are
    lost.
    """

    live = True
    waits_for_listener = False
    start_ns = None
    sensor: Sensor | None = None

    def __init__(self, sensor: Sensor, settings: Settings) -> None:
        """Prepare the link without opening the port."""
        self._declared, self._settings = sensor, settings
        self._stated_roles = channels.parse_channels(settings.channels)
        if self._stated_roles:
            channels.check_roles(self._stated_roles, sensor.axes)
        self.references = channels.reference_columns(self._stated_roles or _DEFAULT_ROLES)
        self._port = SerialPort(settings.port, settings.baud)
        self._splitter = Splitter()
        self._arrivals: deque[_Arrival] = deque()
        self._info: BoardInfo | None = None
        self._conversion: _Conversion | None = None
        self._misfit = self._version_error = ''
        self._counter = FrameCounter()
        self._stamper = Stamper(ClockMap(settings.delay))
        self._frames = self._bad_frames = self._held_back = self._resets = self._rail_frames = 0
        self._last_frame_s = self._created_s = time.monotonic()
        self._longest_frame_s = 0.0
        self._commands = self._ignored_commands = 0
        self._command_due_s = 0.0
        self._busy_until_s = 0.0
        self._unpaid = 0, 0
        self._newest_count = 0

    def begin(self, now_ns: int) -> int:
        """Do nothing: samples before the beginning do not count as lost."""
        return 0

    def read(self, now_ns: int) -> Samples:
        """Wait for bytes, at most 50 ms, and return the samples that they complete."""
        # What need not precede the samples of the last call follows them.
        self._throttle()
        self._command()
        if not self._arrivals:
            self._receive()
        while self._arrivals:
            frame, arrived_ns = self._arrivals[0]
            if isinstance(frame, BoardInfo) and frame != self._info:
                self._stamper.flush()
                if self._stamper.waiting:
                    break  # the samples in the stamper belong to the previous board
            self._arrivals.popleft()
            if isinstance(frame, BoardInfo):
                self._on_info(frame)
            else:
                self._on_samples(frame, arrived_ns)
        samples = self._stamper.take()
        return no_samples(self._declared, time.time_ns()) if samples is None else samples

    def status(self) -> LinkStatus:
        """Return how the port, the frames and the clock work."""
        level, text = self._condition()
        clock = self._stamper.statistics()
        statistics = Statistics(
            frames=self._frames, bad_frames=self._bad_frames, bytes=self._port.received_bytes,
            skipped_bytes=self._splitter.skipped, held_back=self._held_back,
            repeated=self._counter.repeated, device_overruns=self._counter.overruns,
            frame_ms=round(self._longest_frame_s * 1e3, 3), rail_frames=self._rail_frames,
            resets=self._resets, connections=self._port.connections)
        reset = Event('the device was reset or is another one: a new count begins', self._resets)
        return LinkStatus(level, text, (statistics, clock), (reset, *clock_events(clock)))

    def close(self) -> None:
        """Close the port."""
        self._port.close()

    def _condition(self) -> tuple[Level, str]:
        """Return level and text of the status: the first fault of port, frames and channels."""
        if self._port.error:
            return Level.ERROR, self._port.error
        if self._version_error:
            return Level.ERROR, self._version_error
        now_s = time.monotonic()
        port = self._settings.port
        opened_s = max(self._port.opened_s, self._created_s)
        if self._info is None and now_s - opened_s < _INFO_WAIT_S:
            return Level.OK, 'connecting'
        silent_s = now_s - max(self._port.last_byte_s, self._created_s)
        if silent_s > max(_SILENT_S, _SILENT_FRAMES * self._longest_frame_s):
            return Level.WARN, f'{port}: {SILENT}'
        if now_s - self._last_frame_s > max(_NO_FRAME_S, _SILENT_FRAMES * self._longest_frame_s):
            return Level.WARN, (f'{port}: bytes, but no frame of wire format 1: is link.baud '
                                f'({self._settings.baud}) that of the board?')
        if self._misfit:
            return Level.ERROR, self._misfit
        if self._info is None:
            return Level.WARN, f'{port}: waiting for the info frame of the board'
        return Level.OK, self._streaming(self._info)

    def _streaming(self, info: BoardInfo) -> str:
        """Return the text of a working link, with frames that are long and axes without use."""
        return '; '.join(filter(None, (
            f'streaming{self._why_long(info)}', self._unused_channels(info))))

    def _why_long(self, info: BoardInfo) -> str:
        """Return why frames are longer than `link.latency_ms`; '' where they are not."""
        settings = self._settings
        wanted, possible = settings.samples_together(info.rate_hz), self._wanted_samples(info)
        frame_ms = self._longest_frame_s * 1e3
        if possible > wanted and frame_ms > settings.latency_ms:
            possible_ms = min(possible / info.rate_hz * 1e3, frame_ms)
            return (f' in frames of {possible_ms:.3g} ms: {settings.baud} Bd carry none of '
                    f'{settings.latency_ms:g} ms')
        if self._ignored_commands >= _COMMANDS and frame_ms > settings.latency_ms:
            return f' in frames of {frame_ms:.3g} ms: the firmware does not obey link.latency_ms'
        return ''

    def _unused_channels(self, info: BoardInfo) -> str:
        """Return which channels of a board are not read; '' where all are."""
        unused = [axis for axis in AXES[:info.channels] if axis not in self._declared.axes]
        if self._stated_roles or not unused:
            return ''
        return (f'the channel of {", ".join(unused)} is not used: sensor.axes is '
                f'{self._declared.axes} (link.channels can say that it is the supply)')

    def _receive(self) -> None:
        """Read bytes and queue the frames that they complete."""
        chunk = self._port.read()
        if chunk is None:
            # The port opens again, perhaps on another board: an incomplete frame stays incomplete.
            self._splitter.restart()
            self._counter.reopened()
            self._ignored_commands = 0
            return
        arrived_ns = time.monotonic_ns()
        samples = 0
        for raw in self._splitter.split(chunk):
            frame = self._decoded(raw)
            if frame is not None:
                samples += len(frame.codes) if isinstance(frame, SampleFrame) else 1
                self._arrivals.append(_Arrival(frame, arrived_ns))
        self._unpaid = len(chunk), samples

    def _decoded(self, raw: bytes) -> BoardInfo | SampleFrame | None:
        """Decode and count a frame; None for one that cannot be read."""
        try:
            frame = decode(raw)
        except VersionError as error:
            self._version_error = (f'{self._settings.port}: the board speaks {error}, this '
                                   'driver reads 1; use the firmware of this version')
            return None
        except WireError:
            self._bad_frames += 1
            return None
        self._version_error = ''
        self._frames += 1
        self._last_frame_s = time.monotonic()
        self._port.confirm()
        return frame

    def _throttle(self) -> None:
        """Pause so that bytes and samples stay below their largest rates (a leaky bucket)."""
        (size, samples), self._unpaid = self._unpaid, (0, 0)
        rate_hz = self._info.rate_hz if self._info else _UNSTATED_RATE_HZ
        now_s = time.monotonic()
        cost_s = size / _MAX_BYTES_PER_S + samples / (_MAX_RATE_RATIO * rate_hz)
        self._busy_until_s = max(self._busy_until_s, now_s - _CREDIT_S) + cost_s
        if self._busy_until_s > now_s:
            time.sleep(min(self._busy_until_s - now_s, _MAX_PAUSE_S))

    def _on_info(self, info: BoardInfo) -> None:
        """Take the description of the board, where it is new or follows a reset."""
        changed = info != self._info
        if not changed and not info.flags & AFTER_RESET:
            return
        self._info = info
        self._ignored_commands = 0
        self._counter.restart(info.rate_hz)
        self._misfit = self._why_unfit(info)
        self._conversion = None if self._misfit else self._make_conversion(info)
        if changed and not self._misfit:
            self.sensor = replace(self._declared, rate_hz=info.rate_hz, adc_bits=info.bits,
                                  adc_vref_v=info.vref_v,
                                  serial=info.serial or self._declared.serial)

    def _roles(self, info: BoardInfo) -> Sequence[str]:
        """Return the roles of a board's channels, in their order."""
        return self._stated_roles or _DEFAULT_ROLES[:info.channels]

    def _why_unfit(self, info: BoardInfo) -> str:
        """Return why the channels of a board do not fit the sensor; '' where they do."""
        axes = self._declared.axes
        roles = self._roles(info)
        if len(roles) > info.channels:
            return f'link.channels: {len(roles)} are named, the board has {info.channels}'
        if not self._stated_roles:
            roles = [role for role in roles if role not in AXES or role in axes]
        try:
            channels.check_roles(roles, axes)
        except UserError as error:
            return str(error)
        return ''

    def _on_samples(self, frame: SampleFrame, arrived_ns: int) -> None:
        """Check, count and stamp the samples of a frame."""
        info = self._info
        rate_hz = info.rate_hz if info else _UNSTATED_RATE_HZ
        self._longest_frame_s = len(frame.codes) / rate_hz
        self._newest_count = len(frame.codes)
        conversion = self._conversion
        if info is None or conversion is None:
            self._held_back += len(frame.codes)
            return
        if frame.codes.shape[1] != info.channels or _largest(frame.codes) > conversion.max_code:
            self._bad_frames += 1  # whole, but it contradicts the info frame
            return
        for accepted in self._counter.accept(frame, arrived_ns):
            if accepted.lost is None:
                self._resets += self._stamper.period_ns > 0
                self._stamper.restart(1e9 / info.rate_hz)
            elif accepted.stepped:
                self._stamper.step()
            self._rail_frames += accepted.frame.flags & RAIL
            self._stamper.add(conversion.block(accepted.frame), arrived_ns, accepted.lost or 0)

    def _wanted_samples(self, info: BoardInfo) -> int:
        """Return how many samples a frame shall have."""
        wanted = self._settings.samples_together(info.rate_hz)
        return samples_that_fit(wanted, info, self._port.uart_bytes_per_s)

    def _command(self) -> None:
        """
        Ask the board for small frames, unless it sends them or does not obey.

        Only a device that has sent a frame gets bytes: another one could take them for its own
        commands. A board answers with its info frame, so that the first samples need not wait.
        """
        count, self._newest_count = self._newest_count, 0
        if not count:
            return
        latency_us = round(self._settings.latency_ms * 1e3)
        if self._info is not None:
            wanted = self._wanted_samples(self._info)
            if count == wanted:
                self._ignored_commands = 0
                return
            latency_us = max(latency_us, round(wanted / self._info.rate_hz * 1e6))
        now_s = time.monotonic()
        if self._ignored_commands < _COMMANDS and now_s >= self._command_due_s:
            self._port.write(encode_command(self._commands, latency_us))
            self._commands += 1
            self._ignored_commands += 1
            self._command_due_s = now_s + _COMMAND_PAUSE_S

    def _make_conversion(self, info: BoardInfo) -> _Conversion:
        """Return how the codes of a board become samples."""
        roles, settings = self._roles(info), self._settings
        gain, offset = np.full(info.channels, info.vref_v / 2 ** info.bits), np.zeros(
            info.channels)
        for i, role in enumerate(roles):
            if role == channels.SUPPLY:
                gain[i] *= settings.supply_scale
            elif role == channels.TEMPERATURE:
                gain[i] /= settings.temperature_v_per_c
                offset[i] = -settings.temperature_zero_v / settings.temperature_v_per_c
        return _Conversion(
            gain, offset, _columns([roles.index(axis) for axis in self._declared.axes]),
            {column: roles.index(role) if role in roles else None
             for role, column in channels.COLUMNS.items() if column in self.references},
            np.rint(np.arange(MAX_COUNT + 1) * (1e9 / info.rate_hz)).astype(np.int64),
            2 ** info.bits - 1)


def _columns(places: list[int]) -> slice | list[int]:
    """Return what takes columns from an array; a slice, where it can be one, takes no copy."""
    consecutive = range(places[0], places[-1] + 1)
    return slice(consecutive.start, consecutive.stop) if places == list(consecutive) else places


def _largest(codes: np.ndarray) -> int:
    """Return the largest code; few numbers take Python half the time of numpy's first call."""
    return max(map(max, codes.tolist()))
