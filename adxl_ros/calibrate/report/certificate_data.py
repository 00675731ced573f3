# SPDX-License-Identifier: Apache-2.0

"""What a certificate states that no recording shows: laboratory, customer, person and device."""

from __future__ import annotations

from collections.abc import Mapping
import re

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import AnyPath
from adxl_ros.files.parameter_file import compose
import yaml

_NOT_STATED = 'not stated'
_NO_COUNTRY = 'ZZ'  # Code of no country (ISO 3166-1, user-assigned)

DEFAULTS: Mapping[str, str] = {
    'laboratory_name': _NOT_STATED,
    'laboratory_email': _NOT_STATED,
    'laboratory_city': _NOT_STATED,
    'laboratory_country': _NO_COUNTRY,
    'customer_name': _NOT_STATED,
    'customer_email': _NOT_STATED,
    'customer_city': _NOT_STATED,
    'customer_country': _NO_COUNTRY,
    'person': _NOT_STATED,
    'manufacturer': _NOT_STATED,
    'model': '',
    'stage': _NOT_STATED,
}
"""Keys of the file, with what stands for one that is missing. `model` is then that of the
datasheet; `stage` is its identification and certificate."""


def read(path: AnyPath) -> dict[str, str]:
    """Read a YAML file with some keys of `DEFAULTS`; return all of them."""
    node = compose(path)
    if not isinstance(node, yaml.MappingNode):
        raise UserError(f'{path}: has no keys; write for example "laboratory_name: ..."')
    stated = {}
    for name, value in node.value:
        where = f'{path}:{name.start_mark.line + 1}:{name.start_mark.column + 1}'
        if name.value not in DEFAULTS:
            raise UserError(
                f'{where}: {name.value}: unknown key; the keys are {", ".join(DEFAULTS)}'
            )
        text = value.value.strip() if isinstance(value, yaml.ScalarNode) else ''
        if not text:
            raise UserError(f'{where}: {name.value}: is no text')
        if name.value.endswith('_country') and not re.fullmatch('[A-Z]{2}', text):
            raise UserError(
                f'{where}: {name.value}: {text!r} is no code of ISO 3166-1, such as DE or US'
            )
        stated[name.value] = text
    return {**DEFAULTS, **stated}
