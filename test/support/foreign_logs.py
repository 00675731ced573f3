# SPDX-License-Identifier: Apache-2.0

"""Logs of a turned sensor in the forms that other software writes."""

from __future__ import annotations

from dataclasses import dataclass
import struct

from adxl_ros.model.constants import G0_MPS2
import numpy as np

BIAS_G = np.array([0.02, -0.03, 0.047])
"""Bias of the sensor by axis, g."""

SCALE = np.array([1.02, 0.99, 1.01])
"""Scale factor of the sensor by axis."""


@dataclass(frozen=True)
class Turned:
    """A sensor that is turned from rest to rest."""

    time_s: np.ndarray  # Instants, s, (n,)
    output_g: np.ndarray  # Output of the sensor, g, (n, 3)
    angles_rad: np.ndarray  # Stage angles alpha and beta, rad, (n, 2); NaN in motion

    @property
    def tilt_deg(self) -> np.ndarray:
        """Roll and pitch, degrees, (n, 2); NaN in motion."""
        x, y, z = _force(*self.angles_rad.T)
        return np.degrees(np.column_stack([np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))]))


def turned(rate_hz: float = 100.0, rest_s: float = 2.0, seed: int = 3) -> Turned:
    rng = np.random.default_rng(seed)
    forces, angles = [], []
    steps = np.linspace(0, 1, int(0.7 * rate_hz))[:, None]
    for alpha in np.radians([0, 30, 60, 90, 120, 150, 180]):
        for beta in np.radians([0, 60, 120, 180, 240, 300] if 0 < alpha < 3 else [0]):
            force = np.array(_force(alpha, beta))
            if forces:
                forces.append(
                    forces[-1][-1] * (1 - steps) + force * steps + 0.05 * np.sin(40 * steps)
                )
                angles.append(np.full((len(steps), 2), np.nan))
            forces.append(np.tile(force, (int(rest_s * rate_hz), 1)))
            angles.append(np.tile([alpha, beta], (len(forces[-1]), 1)))
    force = np.concatenate(forces)
    output_g = force * SCALE + BIAS_G + rng.normal(0, 0.003, force.shape)
    return Turned(np.arange(len(force)) / rate_hz, output_g, np.concatenate(angles))


def _force(alpha: np.ndarray, beta: np.ndarray) -> list[np.ndarray]:
    """Return the specific force of a pose, g."""
    return [np.sin(alpha) * np.cos(beta), -np.sin(alpha) * np.sin(beta), np.cos(alpha)]


def lines(
    columns: list[np.ndarray],
    formats: list[str],
    delimiter: str = ',',
    decimal: str = '.',
    end: str = '\n',
) -> str:
    """Return rows of text; NaN is an empty field."""
    rows = []
    for row in zip(*columns):
        fields = [
            '' if np.isnan(value) else (form % value).replace('.', decimal)
            for form, value in zip(formats, row)
        ]
        rows.append(delimiter.join(fields) + end)
    return ''.join(rows)


def _arduino(log: Turned) -> str:
    mg = 1e3 * log.output_g.T
    return 't_ms,accX,accY,accZ,temp\n' + lines(
        [1e3 * log.time_s, *mg, 24 + 0 * log.time_s], ['%.0f'] * 4 + ['%.1f']
    )


def _german(log: Turned) -> bytes:
    return (
        'Zeit (s);Acc X [m/s²];Acc Y [m/s²];Acc Z [m/s²]\r\n'
        + lines(
            [log.time_s, *(G0_MPS2 * log.output_g).T], ['%.3f'] + ['%.4f'] * 3, ';', ',', '\r\n'
        )
    ).encode('cp1252')


def _phyphox(log: Turned) -> str:
    names = [f'"Acceleration {axis} (m/s^2)"' for axis in 'xyz']
    return f'"Time (s)",{",".join(names)},"Absolute acceleration (m/s^2)"\n' + lines(
        [log.time_s, *(G0_MPS2 * log.output_g).T, np.linalg.norm(log.output_g, axis=1)],
        ['%.9E'] * 5,
    )


def _counts(log: Turned) -> str:
    return lines([np.arange(len(log.time_s)), *16384 * log.output_g.T], ['%.0f'] * 4, '   ')


def _epoch(log: Turned) -> str:
    rate = 0.1 + 0 * log.time_s
    return 'timestamp,ax,ay,az,gx,gy,gz\n' + lines(
        [1.7e9 + log.time_s, *log.output_g.T, rate, rate, rate], ['%.6f'] + ['%.5f'] * 6
    )


def _units_row(log: Turned) -> str:
    return '% export of a lab program\ntime\tx\ty\tz\n[s]\t[mg]\t[mg]\t[mg]\n' + lines(
        [log.time_s, *1e3 * log.output_g.T], ['%.3f'] + ['%.2f'] * 3, '\t'
    )


def _euroc(log: Turned) -> str:
    names = [
        f'{axis} [{unit}]'
        for sensor, unit in (('w_RS_S', 'rad s^-1'), ('a_RS_S', 'm s^-2'))
        for axis in (f'{sensor}_x', f'{sensor}_y', f'{sensor}_z')
    ]
    rate = 0.02 + 0 * log.time_s
    rows = lines([rate, 2 * rate, 3 * rate, *(G0_MPS2 * log.output_g).T], ['%.5f'] * 6)
    return f'#timestamp [ns],{",".join(names)}\n' + ''.join(
        f'{1_403_636_579_758_555_392 + round(1e9 * time_s)},{row}\n'
        for time_s, row in zip(log.time_s, rows.splitlines())
    )


def _usb(log: Turned) -> str:
    stamps = 0.08 * np.floor(log.time_s / 0.08 + 1e-9)
    return 'time_s,ax_g,ay_g,az_g\n' + lines([stamps, *log.output_g.T], ['%.3f'] + ['%.5f'] * 3)


def _repeated(log: Turned) -> str:
    rows = _arduino(log).splitlines(keepends=True)
    return ''.join([*rows[:200], rows[199], *rows[200:300], *rows[290:293], *rows[300:]])


def _preamble(log: Turned) -> str:
    return 'Device,A\nSample rate,100\nRange,2\n\nTime (s),X (g),Y (g),Z (g)\n' + lines(
        [log.time_s, *log.output_g.T], ['%.3f'] + ['%.4f'] * 3
    )


def _labels(log: Turned) -> str:
    return ''.join(f'X: {x:.4f} Y: {y:.4f} Z: {z:.4f}\n' for x, y, z in log.output_g)


def _unsigned(log: Turned) -> str:
    counts = np.rint(16384 * log.output_g) % 65536
    return 'ms,x,y,z\n' + lines([1e3 * log.time_s, *counts.T], ['%.0f'] * 4)


def _dates(log: Turned) -> str:
    dates = np.datetime64('2026-01-02T03:04:05', 'us') + np.rint(1e6 * log.time_s).astype(int)
    rows = lines([*log.output_g.T], ['%.4f'] * 3, ';', ',').splitlines()
    return 'date;x;y;z\n' + ''.join(
        f'{str(date).replace("T", " ")}+01:00;{row}\n' for date, row in zip(dates, rows)
    )


FORMS = {
    'arduino.csv': _arduino,
    'german.csv': _german,
    'phyphox.csv': _phyphox,
    'counts.txt': _counts,
    'epoch.csv': _epoch,
    'units_row.dat': _units_row,
    'euroc.csv': _euroc,
    'usb.csv': _usb,
    'repeated.csv': _repeated,
    'preamble.csv': _preamble,
    'labels.txt': _labels,
    'unsigned.csv': _unsigned,
    'dates.csv': _dates,
}
"""Text of a log by the name of its file."""


def text_with_angles(log: Turned, angles_deg: np.ndarray, names: str) -> str:
    return f't;x;y;z;{names}\n' + lines(
        [log.time_s, *log.output_g.T, *angles_deg.T], ['%.3f'] + ['%.4f'] * 3 + ['%.3f'] * 2, ';'
    )


def ulog(log: Turned, message: str = 'sensor_accel') -> bytes:
    """Return a log of PX4 with one message (docs.px4.io, ULog file format)."""

    def record(kind: bytes, data: bytes) -> bytes:
        return struct.pack('<Hc', len(data), kind) + data

    fields = (
        'uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;float temperature;'
    )
    parts = [
        b'ULog\x01\x12\x35\x01' + struct.pack('<Q', 0),
        record(b'B', bytes(40)),
        record(b'F', f'{message}:{fields}'.encode()),
        record(b'A', struct.pack('<BH', 0, 0) + message.encode()),
    ]
    parts += [
        record(b'D', struct.pack('<HQQffff', 0, stamp_us + 500, stamp_us, *force, 30.0))
        for stamp_us, force in zip(
            np.rint(1e6 * (1 + log.time_s)).astype(int).tolist(), (G0_MPS2 * log.output_g).tolist()
        )
    ]
    return b''.join(parts)
