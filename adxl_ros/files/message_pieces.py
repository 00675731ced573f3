# SPDX-License-Identifier: Apache-2.0

"""Messages of a bag in pieces, which are handled as arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
import itertools

from adxl_ros.files.cdr import Raws
import numpy as np

_PIECE_MESSAGES = 4096
"""Messages that are collected to a piece (chosen: some MB)."""


@dataclass(frozen=True)
class Piece:
    """Consecutive messages of some topics."""

    messages: Mapping[str, Raws]  # The messages by topic, in the order of recording
    # Where each of them stands in the order of all, by topic, (n,), ascending
    places: Mapping[str, np.ndarray]

    def split(self, topic: str, count: int) -> tuple[Piece, Piece]:
        """Split behind a message."""
        last = self.places[topic][count - 1]
        cuts = {name: int(np.searchsorted(places, last, 'right'))
                for name, places in self.places.items()}
        return (Piece({name: raws[:cuts[name]] for name, raws in self.messages.items()},
                      {name: places[:cuts[name]] for name, places in self.places.items()}),
                Piece({name: raws[cuts[name]:] for name, raws in self.messages.items()},
                      {name: places[cuts[name]:] for name, places in self.places.items()}))


def collected_pieces(messages: Iterable[tuple[str, bytes, int]]) -> Iterator[Piece]:
    """Collect messages with topic and log time, ns, to pieces."""
    iterator = iter(messages)
    while batch := list(itertools.islice(iterator, _PIECE_MESSAGES)):
        yield collected([(topic, raw) for topic, raw, _ in batch])


def collected(messages: list[tuple[str, bytes]]) -> Piece:
    """Collect messages with their topics to one piece."""
    raws: dict[str, list[bytes]] = {topic: [] for topic, _ in messages}
    places: dict[str, list[int]] = {topic: [] for topic in raws}
    for place, (topic, raw) in enumerate(messages):
        raws[topic].append(raw)
        places[topic].append(place)
    return Piece(raws, {topic: np.array(numbers) for topic, numbers in places.items()})
