# SPDX-License-Identifier: Apache-2.0

"""Short synthetic recordings of many units, and the table of a fleet."""

from pathlib import Path

import numpy as np

RATE_HZ = 50.0
SPAN_S = 16.0
TIMING = ['seconds', 'memory_mb', 'worker', 'attempts', 'written']
"""Columns that differ from run to run."""


def recording_text(serial, date, seed, span_s=SPAN_S):
    """Return a CSV recording of a unit at rest with noise of an ADXL203."""
    rng = np.random.default_rng(seed)
    count = round(span_s * RATE_HZ)
    volts = 2.5 + rng.normal(0.0, 0.002, 2)[:, None] + 1e-3 * rng.normal(size=(2, count))
    lines = [
        f'{i / RATE_HZ:.2f},{x:.6f},{y:.6f},{25 + seed % 7 + i / count:.3f}'
        for i, (x, y) in enumerate(volts.T)
    ]
    return '\n'.join(
        [f'# serial: {serial}', f'# date: {date}', 'time_s,x_v,y_v,temperature_c', *lines, '']
    )


def write_fleet(folder, units=3, days=2, first_seed=0, span_s=SPAN_S):
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for unit in range(units):
        for day in range(days):
            path = folder / f'u{unit:04d}_{day:04d}.csv'
            date = f'2026-{10 + day // 28:02d}-{1 + day % 28:02d}T08:00:00Z'
            seed = first_seed + unit * days + day
            path.write_text(recording_text(f'U{unit}', date, seed, span_s))
            paths.append(path)
    return paths


def table_of(folder):
    from pyarrow import parquet

    return parquet.read_table(Path(folder) / 'fleet.parquet').to_pylist()


def without_timing(rows):
    """Return rows without the columns that differ from run to run."""
    return [{name: value for name, value in row.items() if name not in TIMING} for row in rows]


def row_files(folder):
    return {path.name: path.read_bytes() for path in Path(folder, 'rows').glob('[!.]*.json')}
