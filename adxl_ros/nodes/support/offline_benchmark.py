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

"""The part of the benchmark without a graph: frames, files, rests and a fit."""

from __future__ import annotations

from pathlib import Path
import tempfile
import time

from adxl_ros.calibrate import pose_extraction
from adxl_ros.calibrate.fits import paper_regression
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.files.stream_unit import recorded_unit
from adxl_ros.links.support import wire_format
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.simulator import simulate
from adxl_ros.simulate.trajectories import sweep
import numpy as np

_ROWS = 3_000_000
"""Rows of the files that are read; chosen: 50 min at 1 kHz."""
_FRAMES = 20_000
"""Frames of the serial link that are decoded."""
_SAMPLES_PER_FRAME = 10
"""Samples of a frame, as the firmware sends them."""
_RATE_HZ = 1000.0
"""Sample rate of the frames, Hz."""
_FRAME_US = round(_SAMPLES_PER_FRAME / _RATE_HZ * 1e6)
"""Time from frame to frame, µs."""
_CHUNK_BYTES = 4096
"""Bytes of the serial link that come at once."""


def measure_decoding() -> None:
    """Print how many frames of the serial link are decoded in a second."""
    encoder = wire_format.Encoder(wire_format.BoardInfo(_RATE_HZ, 16, 3, 5.0, 'bench'))
    codes = np.random.default_rng(0).integers(1, 65535, (_SAMPLES_PER_FRAME, 3))
    stream = b''.join(encoder.sample_frame(_FRAME_US * k, _SAMPLES_PER_FRAME * k, codes)
                      for k in range(_FRAMES))
    splitter = wire_format.Splitter()
    began_s = time.perf_counter()
    count = 0
    for begin in range(0, len(stream), _CHUNK_BYTES):
        frames = splitter.split(stream[begin:begin + _CHUNK_BYTES])
        for raw in frames:
            wire_format.decode(raw)
        count += len(frames)
    print(f'\n{"frames decoded a second":36} {count / (time.perf_counter() - began_s):8.0f}')


def measure_recordings() -> None:
    """Print how long it takes to read files of 3 million rows, and to calibrate from a sweep."""
    sensor = parameter_file.load(parameter_file.nominal_path())
    columns = simulate(sensor, sweep(np.random.default_rng(0)), 0)
    del columns['time_s']
    print(f'\n{"reading":36} {"rows":>8} {"s":>8}')
    # The long recording repeats the sweep.
    repeated = {name: np.resize(values, _ROWS) for name, values in columns.items()}
    _measure_reading(_recording(sensor, repeated), sensor)
    _measure_fit(_recording(sensor, columns), sensor)


def _recording(sensor: Sensor, columns: dict[str, np.ndarray]) -> Recording:
    """Make a recording of columns, (n,) each, with equal steps of time."""
    count = len(next(iter(columns.values())))
    return Recording('bench', np.arange(count) / sensor.rate_hz, columns, sensor_info(sensor))


def _measure_reading(samples: Recording, sensor: Sensor) -> None:
    """Print how long a recording takes to read as CSV and as a bag."""
    with tempfile.TemporaryDirectory() as folder:
        for name in ('made.csv', 'made_bag'):
            path = Path(folder) / name
            recording.write(path, samples, sensor)
            began_s = time.perf_counter()
            rows = len(recording.read(path))
            print(f'{name:36} {rows:8d} {time.perf_counter() - began_s:8.1f}', flush=True)


def _measure_fit(samples: Recording, sensor: Sensor) -> None:
    """Print how long it takes to find the rests of a sweep, and to fit them."""
    began_s = time.perf_counter()
    poses = pose_extraction.extract_poses(samples, recorded_unit(sensor, samples))
    print(f'{"rests of a sweep":36} {len(samples):8d} {time.perf_counter() - began_s:8.2f}')
    began_s = time.perf_counter()
    paper_regression.fit(sensor, poses)
    print(f'{"physical fit":36} {len(poses):8d} {time.perf_counter() - began_s:8.2f}')
