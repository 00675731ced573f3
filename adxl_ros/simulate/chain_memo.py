# SPDX-License-Identifier: Apache-2.0

"""Signals of one manoeuvre that many simulations share, because only later places differ."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TypeVar

_KEPT = 3
"""Number of results of each part that are kept. Chosen: the baseline, the present hypothesis and
one more; a recording of ten minutes then needs below 100 MB."""

_Result = TypeVar('_Result')


class ChainMemo:
    """Results of parts of the chain by what they depend on, the newest of each part."""

    def __init__(self) -> None:
        self._kept: dict[str, dict[Hashable, object]] = {}

    def __call__(self, part: str, key: Hashable, compute: Callable[[], _Result]) -> _Result:
        """Return a result that was computed before, or compute it."""
        kept = self._kept.setdefault(part, {})
        # The entry moves to the end, so that the one that was not used for longest is dropped.
        kept[key] = kept.pop(key) if key in kept else compute()
        while len(kept) > _KEPT:
            del kept[next(iter(kept))]
        return kept[key]  # type: ignore[return-value]
