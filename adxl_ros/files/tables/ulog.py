# SPDX-License-Identifier: Apache-2.0

"""Logs of PX4 (.ulg), read with the library pyulog: a message is a table, `--topic` names it."""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO
from typing import Any

from adxl_ros.errors import install_hint, UserError
from adxl_ros.files.tables.base import ArrayTable

ENDINGS = ('.ulg',)
"""Ends of the names of such files."""

_MAPPINGS = {
    'sensor_accel': 'time={time}:us,x=x:mps2,y=y:mps2,z=z:mps2,temperature=temperature:c',
    'sensor_combined': 'time=timestamp:us,x=accelerometer_m_s2[0]:mps2,'
                       'y=accelerometer_m_s2[1]:mps2,z=accelerometer_m_s2[2]:mps2',
    'vehicle_acceleration': 'time={time}:us,x=xyz[0]:mps2,y=xyz[1]:mps2,z=xyz[2]:mps2',
    'vehicle_imu': '',
}
"""Columns and units of messages by the definitions of PX4 (msg/*.msg), the raw readings first. A
vehicle_imu has changes of velocity, so that it is only named."""


def open_table(path: str, topic: str = '') -> ArrayTable:
    """Read one message of a log."""
    log = _read(path)
    messages = {_name(data): data for data in log.data_list}
    data = messages.get(topic.removesuffix('_0') or _only(path, messages))
    if data is None:
        raise UserError(f'{path}: no message {topic}; name one of '
                        f'{", ".join(_with_acceleration(messages) or sorted(messages))}')
    columns = {name: values for name, values in data.data.items()
               if getattr(values, 'dtype', None) is not None and values.dtype.kind in 'iuf'}
    time = 'timestamp_sample' if columns.get('timestamp_sample', [0])[0] else 'timestamp'
    mapping = _MAPPINGS.get(data.name, '').format(time=time)
    if 'temperature' not in columns:
        mapping = mapping.partition(',temperature=')[0]
    return ArrayTable(path, columns, {'timestamp': 'us', 'timestamp_sample': 'us'}, mapping,
                      cut=f'{path}: is damaged; what can be read of it is used'
                      if log.file_corruption else '')


def _name(data: Any) -> str:
    """Return the name of a message; its first instance has no number."""
    return f'{data.name}_{data.multi_id}' if data.multi_id else str(data.name)


def _with_acceleration(messages: dict[str, Any]) -> list[str]:
    """Return the messages that hold acceleration."""
    return [name for kind in _MAPPINGS for name in messages
            if messages[name].name == kind and _MAPPINGS[kind]]


def _only(path: str, messages: dict[str, Any]) -> str:
    """Return the message with the raw readings; several sensors are refused."""
    names = _with_acceleration(messages)
    if not names:
        raise UserError(f'{path}: holds no acceleration; name a message with --topic: '
                        f'{", ".join(sorted(messages)) or "it has none"}')
    raw = [name for name in names if messages[name].name == messages[names[0]].name]
    if len(raw) > 1:
        raise UserError(f'{path}: several accelerometers: {", ".join(raw)}; choose one: --topic '
                        f'{raw[0]}')
    return raw[0]


def _read(path: str) -> Any:
    """Return the parsed log."""
    try:
        from pyulog import ULog
    except ImportError:
        raise UserError(f'{path}: logs of PX4 need the Python package pyulog: '
                        f'{install_hint("pyulog")}') from None
    try:
        # The library prints its warnings.
        with redirect_stdout(StringIO()):
            return ULog(path)
    except OSError as error:
        raise UserError(f'{path}: cannot read: {error.strerror or error}') from None
    except Exception as error:
        # In a damaged file, pyulog can raise errors of any kind.
        raise UserError(f'{path}: cannot read it as a log of PX4: '
                        f'{" ".join(str(error).split()) or type(error).__name__}') from None
