# SPDX-License-Identifier: Apache-2.0

"""The quick ways to read and write the numbers of CSV files do the same as the plain ways."""

import sys

from adxl_ros.files import csv_file, delimited_text
from adxl_ros.files.delimited_text import Layout, Lines
import numpy as np
import pytest

CELLS = ('', 'nan', 'NaN', '-nan', 'inf', '-Infinity', '+1.5', '1.', '.5', '1E+5', '1e400',
         '1e-400', '0x10', '1_000', ' 1.5 ', '\t2', ' ', '"1.5"', 'text', '1e', 'NULL', 'nan(1)',
         '1\x00', '-0', '5e-324', '2.2250738585072011e-308', '1.7976931348623159e308',
         '9007199254740992.5', '1.00000000000000011102230246251565404236316680908203125',
         '1\v', '1\xa0', '١', 'True', '2026-11-24')
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


def test_both_parsers_read_the_same() -> None:
    rng = np.random.default_rng(8)
    parsed = 0
    for _ in range(2000):
        rows = [','.join(any_field(rng) for _ in range(3)) for _ in range(2)]
        lines = Lines('a.csv', '\n'.join([*rows, '']).encode(), range(1, 3))
        layout = Layout(('a', 'b', 'c'), ['a', 'c'], frozenset('ac'))
        columns = delimited_text._by_pandas(layout, lines)
        if columns is not None:
            parsed += 1
            plain = delimited_text._field_by_field(layout, lines)
            assert all(same_bits(columns[name], plain[name]) for name in 'ac'), rows
    assert parsed > 500


@pytest.mark.parametrize('library', ['pyarrow', 'pandas'])
def test_the_text_of_numbers_keeps_their_bits(library: str, monkeypatch: pytest.MonkeyPatch
                                              ) -> None:
    if library == 'pandas':
        monkeypatch.setitem(sys.modules, 'pyarrow.csv', None)
    rng = np.random.default_rng(9)
    columns = {
        'plain': rng.normal(size=4000),
        'bits': rng.integers(0, 2 ** 64, 4000, dtype=np.uint64).view(float),
        'edges': np.nextafter(10.0 ** rng.integers(-6, 18, 4000), np.inf),
        'special': rng.choice([0.0, -0.0, np.nan, np.inf, -np.inf, 1.0, 1e12, 5e-324], 4000)}
    rows = [line.split(',') for line in csv_file._rows(columns).decode().splitlines()]
    for texts, values in zip(zip(*rows), columns.values()):
        assert same_bits(np.array([float(text or 'nan') for text in texts]), values)
    for digits in (12, 6):
        for values in (columns[name] for name in ('plain', 'edges', 'special')):
            expected = [float(f'%.{digits}g' % value) for value in values]
            np.testing.assert_allclose(csv_file._rounded(values, digits), expected, rtol=1e-15)
