# SPDX-License-Identifier: Apache-2.0
"""Tables of made-up fleets: units of a population, recorded again and again."""

from dataclasses import dataclass

from adxl_ros.fleet.row import arrow_schema
import numpy as np
import pytest

pa = pytest.importorskip('pyarrow')
pq = pytest.importorskip('pyarrow.parquet')

SCALE_V_PER_G = 1.0
MPS2_PER_MG = 9.80665e-3


@dataclass(frozen=True)
class MadeUpFleet:
    """Drawn units, and what is wrong with some of them."""

    units: int = 20  # Number of units
    per_unit: int = 10  # Recordings of each unit, spread over a year
    # Number of units whose serial numbers begin with B and that have temperature_bias
    batch: int = 0
    batch_scale: float = 1.0  # Scale factor of these units over that of the others
    drifting_mg: float = 0.0  # Drift of the zero-g of unit A-0003, mg per year
    # Rise of the noise of unit A-0005 on y, of its value, per year
    rising_noise: float = 0.0
    refused: float = 0.0  # Share of refused recordings
    # Whether the recordings on stage 2, a fifth of all, have stage_eccentricity
    stage_fault: bool = False

    def write(self, folder, seed=0):
        rng = np.random.default_rng(seed)
        n, m = self.units * self.per_unit, self.units
        unit = np.repeat(np.arange(m), self.per_unit)
        year = np.sort(rng.uniform(0, 1, (m, self.per_unit)), axis=1).ravel()
        in_batch = unit >= m - self.batch
        serial = [f'{"B" if bad else "A"}-{number:04d}' for number, bad in zip(unit, in_batch)]
        calibrated = np.where(unit == 3, 0.4, rng.uniform(-0.5, 0.5, m)[unit])
        second = (year > calibrated) & (calibrated > 0)
        age_year = np.where(second, year - calibrated, year + 0.2)
        stage = rng.integers(1, 6, m)[unit] if self.stage_fault else np.ones(n, int)
        refused = rng.uniform(size=n) < self.refused
        done = ~refused
        drift_v = np.where(unit == 3, self.drifting_mg * 1e-3 * year, 0.0)
        columns = {
            'url': [
                f'/data/stage{s}/{name}/{i:06d}.mcap'
                for i, (s, name) in enumerate(zip(stage, serial))
            ],
            'hash': [f'{i:064x}' for i in range(n)],
            'serial': serial,
            'date': (year * 31_557_600e6 + 1_750_000_000e6).astype('datetime64[us]'),
            'outcome': np.where(refused, 'refused', 'done'),
            'refused_by': np.where(refused, 'diagnose', None),
            'refusal': [
                f'{i:06d}.mcap: line {3 * i}: no time stamp' if bad else None
                for i, bad in enumerate(refused)
            ],
            'calibration_id': [f'{name}-{int(b)}' for name, b in zip(serial, second)],
            'calibration_age_days': 365.25 * age_year,
            'duration_s': np.full(n, 60.0),
            'version': ['0.1.0'] * n,
            'seconds': rng.uniform(5, 20, n),
        }
        for axis in 'xy':
            level = (2.5 + rng.normal(0, 0.02, m))[unit] + drift_v * (axis == 'x')
            zero_g = level + rng.normal(0, 4e-4, n)
            std = rng.uniform(1e-4, 3e-4, n)
            columns[f'zero_g_{axis}_v'] = zero_g + std * rng.normal(size=n)
            columns[f'zero_g_std_{axis}_v'] = std
            scale = (SCALE_V_PER_G + rng.normal(0, 0.01, m))[unit] + rng.normal(0, 2e-4, n)
            scale *= np.where(in_batch, self.batch_scale, 1.0)
            columns[f'scale_{axis}_v_per_g'] = scale + 1e-4 * rng.normal(size=n)
            columns[f'scale_std_{axis}_v_per_g'] = np.full(n, 1e-4)
            noise = 1.08e-3 * (1 + rng.normal(0, 0.05, m))[unit] * (1 + rng.normal(0, 0.02, n))
            noise *= np.where((unit == 5) & (axis == 'y'), 1 + self.rising_noise * year, 1.0)
            columns[f'noise_n_{axis}_mps2_per_rthz'] = noise
            columns[f'noise_n_low_{axis}_mps2_per_rthz'] = 0.97 * noise
            columns[f'noise_n_high_{axis}_mps2_per_rthz'] = 1.03 * noise
        gap_mg = np.hypot(
            0.6,
            np.abs(rng.normal(0.5, 0.1, m))[unit] + 2.0 * in_batch + 1e3 * drift_v / SCALE_V_PER_G,
        ) * (1 + rng.normal(0, 0.05, n))
        columns |= {
            'gap_before_mps2': gap_mg * MPS2_PER_MG,
            'gap_before_low_mps2': 0.95 * gap_mg * MPS2_PER_MG,
            'gap_before_high_mps2': 1.05 * gap_mg * MPS2_PER_MG,
            'gap_floor_mps2': np.full(n, 0.6 * MPS2_PER_MG),
        }
        effects = []
        for i in range(n):
            named = ['temperature_bias'] if in_batch[i] and rng.uniform() < 0.9 else []
            named += ['stage_eccentricity'] if self.stage_fault and stage[i] == 2 else []
            named += (
                [str(rng.choice(['bias_walk', 'lever_arm', 'flicker', 'hysteresis']))]
                if rng.uniform() < 0.03
                else []
            )
            effects.append(named if done[i] else [])
        columns['effects'] = effects
        columns['status'] = [
            ('explained' if named else 'no_gap') if ok else None
            for named, ok in zip(effects, done)
        ]
        return write_columns(folder, columns, done)


def write_columns(folder, columns, done):
    """Write a table whose other columns are empty; rows that are not done have no figures."""
    schema, n = arrow_schema(), len(done)
    arrays = []
    for field in schema:
        values = columns.get(field.name)
        if values is None:
            arrays.append(pa.nulls(n, field.type))
            continue
        missing = (
            None
            if field.type != pa.float64() or field.name == 'calibration_age_days'
            else ~np.asarray(done)
        )
        arrays.append(pa.array(values, field.type, mask=missing, from_pandas=True))
    path = folder / 'fleet.parquet'
    pq.write_table(pa.Table.from_arrays(arrays, schema=schema), path)
    return path
