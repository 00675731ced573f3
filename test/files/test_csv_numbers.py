# SPDX-License-Identifier: Apache-2.0

"""The quick ways to read and write the numbers of CSV files do the same as the plain ways."""

from adxl_ros.files import csv_numbers
from adxl_ros.files.csv_lines import Lines
from adxl_ros.files.csv_numbers import Layout
import numpy as np
import pytest

CELLS = ('', 'nan', 'NaN', '-nan', 'inf', '-Infinity', '+1.5', '1.', '.5', '1E+5', '1e400',
         '1e-400', '0x10', '1_000', ' 1.5 ', '\t2', ' ', '"1.5"', 'text', '1e', 'NULL', 'nan(1)',
         '1\x00', '-0', '5e-324', '2.2250738585072011e-308', '1.7976931348623159e308',
         '9007199254740992.5', '1.00000000000000011102230246251565404236316680908203125',
         '\ufeff1', '1\v', '1\xa0', '١')
"""Fields that a parser may read in another way than Python."""


def any_field(rng: np.random.Generator) -> str:
    """Return a random field, mostly a number with up to 40 digits."""
    kind = rng.integers(6)
    if kind == 0:
        return str(rng.choice(CELLS))
    if kind == 1:
        return f'{rng.normal() * 10.0 ** rng.integers(-300, 300):.{rng.integers(25)}e}'
    if kind == 2:
        return ''.join(rng.choice(list('0123456789'), rng.integers(1, 40))) + '.5'
    return repr(float(rng.normal()))


def same_bits(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether two float64 arrays are equal, with NaN equal to NaN."""
    return np.array_equal(first, second, equal_nan=True) and np.array_equal(
        np.signbit(first[~np.isnan(first)]), np.signbit(second[~np.isnan(second)]))


def test_both_parsers_read_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('pyarrow')
    monkeypatch.setattr(csv_numbers, '_ARROW_BYTES', 0)
    rng = np.random.default_rng(8)
    parsed = 0
    for _ in range(2000):
        rows = [','.join(any_field(rng) for _ in range(3)) for _ in range(2)]
        lines = Lines('\n'.join([*rows, '']).encode(), range(1, 3), 1.0, False)
        layout = Layout('a.csv', ('a', 'b', 'c'), ['a', 'c'], frozenset('ac'))
        columns = csv_numbers._by_arrow(layout, lines)
        if columns is not None:
            parsed += 1
            table = csv_numbers._field_by_field(layout, lines)
            assert all(map(same_bits, columns.values(), table.T)), rows
    assert parsed > 500
