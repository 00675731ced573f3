# SPDX-License-Identifier: Apache-2.0

"""How a recording is to be read where its form alone does not state it."""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.files.column_mapping import ColumnMapping, Mounting


@dataclass(frozen=True)
class ReadingOptions:
    """How a recording is to be read."""

    # Topic of the samples in a bag, or message of a ULog file; empty for the only one
    topic: str = ''
    mapping: ColumnMapping | None = None  # Columns of a table; None for those of the package
    # Counts of 1 g by axis, for columns in LSB: one for all axes, or one each
    lsb_per_g: tuple[float, ...] = ()
    lsb_at_0g: tuple[float, ...] = ()  # Counts at 0 g by axis, for columns in LSB; none for 0
    rate_hz: float | None = None  # Sample rate, Hz, that replaces the stamps; None keeps them
    drop_bad_stamps: bool = False  # Whether samples are left out whose stamp does not increase
    # How the axes of the file are those of the sensor frame; None where they are
    mounting: Mounting | None = None

    @property
    def changes_columns(self) -> bool:
        """Return whether the columns of a table are converted."""
        return self != ReadingOptions(topic=self.topic, mounting=self.mounting)


AS_IT_IS = ReadingOptions()
"""Nothing is replaced."""
