# SPDX-License-Identifier: Apache-2.0

"""A microcontroller with an ADC on a serial port, in wire format 1."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
import time

from adxl_ros.errors import UserError
from adxl_ros.links.support import stamping, wire_format
from adxl_ros.links.support.base import (
    check_roles,
    COLUMNS,
    DeviceSettings,
    Event,
    Level,
    Link,
    LinkStatus,
    option,
    parse_channels,
    Samples,
    SUPPLY,
    TEMPERATURE,
    UNUSED,
)
from adxl_ros.links.support.clock_map import ClockMap
from adxl_ros.links.support.clock_rate import ClockRate
from adxl_ros.links.support.serial_port import import_pyserial, Port, SILENT
from adxl_ros.links.support.stamping import Stamper
from adxl_ros.links.support.wire_format import BoardInfo, SampleFrame
from adxl_ros.model.constants import AXES
from adxl_ros.model.sensor import Sensor
import numpy as np

_DEFAULT_ROLES = (*AXES, SUPPLY)
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
_SELF_TEST_S = 0.1  # Time between two commands that keep the self-test as it is, s
_DEAD_S = 3.0
"""Time without a sample after which a board counts as failed, s. Chosen: a reset and its info
frame take less."""
_SILENT_FRAMES = 3  # A board also counts as silent only after this many times its longest frame
_MAX_BYTES_PER_S = 4e6
"""Bytes that are read per second at most. Chosen: more than USB full speed carries."""
_MAX_RATE_RATIO = 20.0
"""Samples are read at this many times the stated rate at most. What comes faster waits in the
kernel or is lost there. So no device can keep the node busy or fill its memory."""
_CREDIT_S = 0.2
"""Reading time that a link saves up for a burst, s. Chosen: the backlog of a stall is read at
once."""
_MAX_PAUSE_S = 0.05  # Longest pause of one read, s, so that the driver reacts to its end
_UNSTATED_RATE_HZ = 1000.0  # Sample rate before the info frame, Hz: that of the firmware


@dataclass(frozen=True)
class Settings(DeviceSettings):
    """Settings of the link."""

    port: str = option('', 'device path, such as /dev/ttyACM0, or a pyserial URL')
    baud: int = option(
        115200, 'baud rate of a UART; USB and network ports ignore it', 'Bd', 50, 100_000_000
    )
    # A list of strings, or one string with commas
    channels: str | Sequence[str] = option(
        (),
        'roles of the channels of a frame: x, y, z, supply, temperature, or - for unused; '
        'empty: the first channels are x, y, z, supply',
    )
    temperature_zero_v: float = option(
        0.5, 'output of the temperature sensor at 0 degC', 'V', -10.0, 10.0
    )
    temperature_v_per_c: float = option(
        0.01, 'slope of the temperature sensor', 'V/degC', -10.0, 10.0
    )


def open_link(sensor: Sensor, settings: Settings) -> SerialLink:
    """Check the settings; `SerialLink.read` opens the port, and opens it again after each loss."""
    if not settings.port:
        raise UserError('link.port: names no port; set it to a device path or a pyserial URL')
    if not settings.temperature_v_per_c:
        raise UserError('link.temperature_v_per_c: is 0; set the slope of the temperature sensor')
    import_pyserial()
    return SerialLink(sensor, settings)


class _Conversion:
    """How the codes of a board become samples; raises `UserError` where they cannot."""

    def __init__(
        self, info: BoardInfo, roles: Sequence[str], axes: str, settings: Settings
    ) -> None:
        if len(roles) > info.channels:
            raise UserError(
                f'link.channels: {len(roles)} are named, the board has {info.channels}'
            )
        check_roles(roles, axes)
        self.max_code = 2**info.bits - 1
        # Value of a channel is gain · code + offset, V or degC, (m,)
        self._gain = np.full(info.channels, info.vref_v / 2**info.bits)
        self._offset = np.zeros(info.channels)
        for i, role in enumerate(roles):
            if role == SUPPLY:
                self._gain[i] *= settings.supply_scale
            elif role == TEMPERATURE:
                self._gain[i] /= settings.temperature_v_per_c
                self._offset[i] = -settings.temperature_zero_v / settings.temperature_v_per_c
        self._axes = [roles.index(axis) for axis in axes]
        self._references = {
            column: roles.index(role) for role, column in COLUMNS.items() if role in roles
        }
        # Times of the samples of a frame after its first one, ns
        self._steps_ns = np.rint(
            np.arange(wire_format.MAX_COUNT + 1) * (1e9 / info.rate_hz)
        ).astype(np.int64)

    def block(self, frame: SampleFrame, lost: int) -> stamping.Block:
        """Return the samples of a frame."""
        values = frame.codes * self._gain + self._offset
        return stamping.Block(
            frame.time_us * 1000 + self._steps_ns[: len(values)],
            values[:, self._axes],
            {column: values[:, i] for column, i in self._references.items()},
            lost,
            bool(frame.flags & wire_format.IN_SELF_TEST),
        )


class SerialLink(Link):
    """
    The samples of a board, each once and in order, stamped by the clock of the board.

    Bytes that are no whole frame are skipped. The numbers of the board show which samples are
    lost.
    """

    def __init__(self, sensor: Sensor, settings: Settings) -> None:
        self._declared = sensor
        self._settings = settings
        self._stated_roles = parse_channels(settings.channels)
        if self._stated_roles:
            check_roles(self._stated_roles, sensor.axes)
        self.references = tuple(
            column
            for role, column in COLUMNS.items()
            if role in (self._stated_roles or _DEFAULT_ROLES)
        )
        self._port = Port(settings.port, settings.baud)
        self._splitter = wire_format.Splitter()
        # Decoded frames with the monotonic times of their arrivals, ns
        self._arrivals: deque[tuple[BoardInfo | SampleFrame, int]] = deque()
        self._info: BoardInfo | None = None
        self._conversion: _Conversion | None = None
        self._misfit = ''
        self._rate = ClockRate(_UNSTATED_RATE_HZ)
        self._counter = wire_format.FrameCounter()
        self._stamper = Stamper(ClockMap(settings.delay), self.references)
        self._frame_s = 0.0  # Duration of the newest frame, s
        self._unjudged = self._commands = 0  # Samples of a frame that is new; commands so far
        self._command_due_s = self._self_test_due_s = self._held_s = 0.0
        self._counts: Counter[str] = Counter()
        self._last_frame_s = self._last_sample_s = self._created_s = time.monotonic()
        self._busy_until_s = self._unpaid_s = 0.0

    def read(self, now_ns: int) -> Samples:
        """Wait for bytes, at most 50 ms, and return the samples that they complete."""
        # What need not precede the samples of the last call follows them.
        self._throttle()
        self._ask_for_short_frames()
        if not self._arrivals:
            self._receive()
        while self._arrivals:
            frame, arrived_ns = self._arrivals[0]
            if isinstance(frame, BoardInfo) and frame != self._info and self._stamper.flush():
                break  # the samples in the stamper belong to the previous board
            self._arrivals.popleft()
            if isinstance(frame, BoardInfo):
                self._on_info(frame)
            else:
                self._on_samples(frame, arrived_ns)
        return self._stamper.take(self._declared)

    def status(self) -> LinkStatus:
        """Return how the port, the frames and the clock work."""
        level, text = self._condition()
        counts = self._counts
        statistics = {
            'frames': counts['frames'],
            'bad_frames': counts['bad_frames'],
            'bytes': self._port.received_bytes,
            'skipped_bytes': self._splitter.skipped,
            'held_back': counts['held_back'],
            'repeated': self._counter.repeated,
            'device_overruns': self._counter.overruns,
            'frame_ms': round(self._frame_s * 1e3, 3),
            'rail_frames': counts['rail_frames'],
            'resets': counts['resets'],
            'connections': self._port.connections,
            **self._stamper.statistics(),
        }
        reset = Event(
            'the device was reset or is another one: a new count begins', counts['resets']
        )
        return LinkStatus(level, text, statistics, (reset, *self._stamper.events()))

    def hold_self_test(self, hold_s: float) -> None:
        """Tell the board again and again; it ends the self-test by itself when this stops."""
        if self._info is None or not self._info.flags & wire_format.HAS_SELF_TEST:
            raise UserError(
                f'{self._settings.port}: no board that has a self-test line answers: connect that '
                'of the sensor, and state its pin in the firmware'
            )
        now_s = time.monotonic()
        if hold_s != self._held_s or now_s >= self._self_test_due_s:
            self._held_s = hold_s
            self._self_test_due_s = now_s + _SELF_TEST_S
            self._command(round(hold_s * 1e6), wire_format.SELF_TEST_TYPE)

    def close(self) -> None:
        """Close the port; a self-test ends before."""
        if self._held_s:
            self._command(0, wire_format.SELF_TEST_TYPE)
        self._port.close()

    def _command(self, time_us: int, kind: int = wire_format.LATENCY_TYPE) -> None:
        self._port.write(wire_format.encode_command(self._commands, time_us, kind))
        self._commands += 1

    def _condition(self) -> tuple[Level, str]:
        """Return level and text of the status: the first fault of port, frames and board."""
        port = self._settings.port
        info = self._info
        if self._port.error:
            return Level.ERROR, self._port.error
        now_s = time.monotonic()
        if info is None and now_s - max(self._port.opened_s, self._created_s) < _INFO_WAIT_S:
            return Level.OK, 'connecting'
        if obstacle := self._obstacle(now_s):
            if now_s - self._last_sample_s > _DEAD_S:
                return (
                    Level.ERROR,
                    f'{port}: {obstacle}; no sample for more than {_DEAD_S:g} s',
                )
            return Level.WARN, f'{port}: {obstacle}'
        if self._misfit:
            return Level.ERROR, self._misfit
        if contradiction := self._rate.fault:
            return Level.ERROR, f'{port}: the board {contradiction} in its info frame'
        return Level.OK, 'streaming'

    def _obstacle(self, now_s: float) -> str:
        """Return why no samples come at a monotonic time, s, or ''."""
        long_s = _SILENT_FRAMES * self._frame_s
        if now_s - max(self._port.last_byte_s, self._created_s) > max(_SILENT_S, long_s):
            return SILENT
        if now_s - self._last_frame_s > max(_NO_FRAME_S, long_s):
            return (
                f'bytes, but no frame of wire format 1: is link.baud ({self._settings.baud}) '
                'that of the board, and its firmware of this version?'
            )
        return 'waiting for the info frame of the board' if self._info is None else ''

    def _ask_for_short_frames(self) -> None:
        """
        Ask a board for frames that are as short as the latency, until it obeys.

        Only a device that has sent a frame gets bytes: another one could take them for its own
        commands. A board answers with its info frame, so that the first samples need not wait.
        """
        now_s = time.monotonic()
        info = self._info
        count = self._unjudged
        self._unjudged = 0
        if not count or now_s < self._command_due_s:
            return
        latency_us = round(self._settings.latency_ms * 1e3)
        if info is not None:
            wanted = wire_format.samples_that_fit(
                self._settings.samples_together(info.rate_hz), info, self._port.uart_bytes_per_s
            )
            if count == wanted:
                return
            latency_us = max(latency_us, round(wanted / info.rate_hz * 1e6))
        self._command(latency_us)
        self._command_due_s = now_s + _COMMAND_PAUSE_S

    def _receive(self) -> None:
        """Read bytes and queue the frames that they complete."""
        chunk = self._port.read()
        if chunk is None:
            # The port opens again, perhaps on another board: an incomplete frame stays incomplete.
            self._splitter.restart()
            self._counter.reopened()
            return
        arrived_ns = time.monotonic_ns()
        samples = 0
        for raw in self._splitter.split(chunk):
            try:
                frame = wire_format.decode(raw)
            except wire_format.WireError:
                self._counts['bad_frames'] += 1
                continue
            self._counts['frames'] += 1
            self._last_frame_s = time.monotonic()
            self._port.backoff.reset()
            samples += len(frame.codes) if isinstance(frame, SampleFrame) else 1
            self._arrivals.append((frame, arrived_ns))
        rate_hz = self._info.rate_hz if self._info else _UNSTATED_RATE_HZ
        self._unpaid_s = len(chunk) / _MAX_BYTES_PER_S + samples / (_MAX_RATE_RATIO * rate_hz)

    def _throttle(self) -> None:
        """Pause so that bytes and samples stay below their largest rates (a leaky bucket)."""
        now_s = time.monotonic()
        self._busy_until_s = max(self._busy_until_s, now_s - _CREDIT_S) + self._unpaid_s
        self._unpaid_s = 0.0
        if self._busy_until_s > now_s:
            time.sleep(min(self._busy_until_s - now_s, _MAX_PAUSE_S))

    def _on_info(self, info: BoardInfo) -> None:
        """Take the description of the board, where it is new or follows a reset."""
        changed = info != self._info
        if not changed and not info.flags & wire_format.AFTER_RESET:
            return
        is_other_rate = self._rate.used_hz != info.rate_hz
        self._info = info
        self._rate = ClockRate(info.rate_hz)
        self._use(info, changed or is_other_rate)

    def _use(self, info: BoardInfo, changed: bool = True) -> None:
        """Read further samples by a description of the board; its sensor may have changed."""
        self._conversion = None
        self._misfit = ''
        self._counter.restart(info.rate_hz)
        axes = self._declared.axes
        roles = self._stated_roles or [
            UNUSED if role in AXES and role not in axes else role
            for role in _DEFAULT_ROLES[: info.channels]
        ]
        try:
            self._conversion = _Conversion(info, roles, axes, self._settings)
        except UserError as error:
            self._misfit = str(error)
            return
        if changed:
            self.sensor = replace(
                self._declared,
                rate_hz=info.rate_hz,
                adc_bits=info.bits,
                adc_vref_v=info.vref_v,
                serial=info.serial or self._declared.serial,
            )

    def _on_samples(self, frame: SampleFrame, arrived_ns: int) -> None:
        """Check, count and stamp the samples of a frame."""
        info = self._info
        conversion = self._conversion
        count = len(frame.codes)
        self._unjudged = count
        self._frame_s = count / (info.rate_hz if info else _UNSTATED_RATE_HZ)
        if info is None or conversion is None:
            self._counts['held_back'] += count
            return
        # The largest of few numbers takes Python half the time of numpy's first call.
        if (
            frame.codes.shape[1] != info.channels
            or max(map(max, frame.codes.tolist())) > conversion.max_code
        ):
            self._counts['bad_frames'] += 1  # whole, but it contradicts the info frame
            return
        self._last_sample_s = time.monotonic()
        is_other_rate = self._rate.compare(frame.index, frame.time_us)
        if is_other_rate:
            self._use(replace(info, rate_hz=self._rate.used_hz))
            conversion = self._conversion or conversion
        for accepted in self._counter.accept(frame, arrived_ns):
            if accepted.lost is None:
                self._counts['resets'] += self._stamper.period_ns > 0 and not is_other_rate
                self._stamper.restart(1e9 / self._rate.used_hz)
            elif accepted.stepped:
                self._stamper.step()
            self._counts['rail_frames'] += accepted.frame.flags & wire_format.RAIL
            self._stamper.add(conversion.block(accepted.frame, accepted.lost or 0), arrived_ns)
