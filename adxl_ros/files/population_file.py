# SPDX-License-Identifier: Apache-2.0

"""
The file of a population: YAML with mean and spread of each coefficient over the units of a fleet.

`fleet` writes it, and `fit --prior` and `diagnose --prior` read it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
import math
import os
from pathlib import Path
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.parameter_file import compose
from adxl_ros.model.population import PooledCoefficient, Population
from adxl_ros.process import package_version
import yaml

FORMAT = 1
"""Version of the format. A file of another version is refused."""
_DIGITS = 9
"""Significant digits of the values (chosen: far below any uncertainty)."""
_HEAD = """\
# Mean and spread of each coefficient over the units of a fleet, written by fleet.
# The name of a coefficient is its column of fleet.parquet, which ends in its unit.
# prediction_std is the standard deviation of a further unit about the mean.
# Use it: ros2 run adxl_ros fit NEW.mcap --prior {name} -o unit.yaml
"""
"""Comments at the begin of the file."""


def write(path: str | os.PathLike, population: Population, far_out: Sequence[Mapping[str, Any]]
          ) -> None:
    """Write a population."""
    contents = {
        'format': FORMAT, 'version': package_version(),
        'coefficients': {name: {key: _rounded(value) for key, value in asdict(pooled).items()}
                         for name, pooled in population.coefficients.items()},
        'far_out': [{key: _rounded(value) for key, value in unit.items()} for unit in far_out]}
    text = yaml.safe_dump(contents, sort_keys=False, allow_unicode=True, default_flow_style=None)
    write_text(path, _HEAD.format(name=Path(path).name) + text)


def _rounded(value: Any) -> Any:
    return float(f'{value:.{_DIGITS}g}') if isinstance(value, float) else value


def read(path: str | os.PathLike) -> Population:
    """Read and check a population."""
    node = compose(path)
    contents = yaml.constructor.SafeConstructor().construct_document(node) if node else None
    if not isinstance(contents, dict) or contents.get('format') != FORMAT \
            or not isinstance(contents.get('coefficients'), dict):
        raise UserError(f'{path}: no population of format {FORMAT}; give the population.yaml '
                        'that fleet writes')
    pooled = {str(name): _coefficient(f'{path}: coefficients.{name}', values)
              for name, values in contents['coefficients'].items()}
    return Population(Path(path).name, pooled)


def _coefficient(place: str, values: Any) -> PooledCoefficient:
    """Check one coefficient."""
    if not isinstance(values, dict):
        raise UserError(f'{place}: {values!r} is no mapping of mean, spread and others')
    for field in fields(PooledCoefficient):
        value = values.get(field.name)
        if isinstance(value, bool) or not isinstance(value, (int, float)) \
                or not math.isfinite(value):
            raise UserError(f'{place}.{field.name}: {value!r} is no number')
    if not values['prediction_std'] > 0:
        raise UserError(f'{place}.prediction_std: {values["prediction_std"]!r} must be positive')
    return PooledCoefficient(**{field.name: values[field.name]
                                for field in fields(PooledCoefficient)})
