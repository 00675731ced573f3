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
        """
        Return a result that was computed before, or compute it.

        Parameters
        ----------
        part
            Name of the part.
        key
            Everything that the result depends on.
        compute
            Computes the result.

        Returns
        -------
        object
            The result; several callers share it.

        """
        kept = self._kept.setdefault(part, {})
        # The entry moves to the end, so that the one that was not used for longest is dropped.
        kept[key] = kept.pop(key) if key in kept else compute()
        while len(kept) > _KEPT:
            del kept[next(iter(kept))]
        return kept[key]  # type: ignore[return-value]
