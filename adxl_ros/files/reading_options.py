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

"""How a recording is to be read where its form alone does not state it."""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.files.column_mapping import ColumnMapping, Mounting


@dataclass(frozen=True)
class ReadingOptions:
    """
    How a recording is to be read.

    Attributes
    ----------
    topic
        Topic of the samples in a bag, or message of a ULog file; empty for the only one.
    mapping
        Columns of a table; None for those of the package.
    lsb_per_g
        Counts of 1 g by axis, for columns in LSB: one for all axes, or one each.
    lsb_at_0g
        Counts at 0 g by axis, for columns in LSB; none for 0.
    rate_hz
        Sample rate, Hz, that replaces the stamps; None keeps them.
    drop_bad_stamps
        Whether samples are left out whose stamp does not increase.
    mounting
        How the axes of the file are those of the sensor frame; None where they are.

    """

    topic: str = ''
    mapping: ColumnMapping | None = None
    lsb_per_g: tuple[float, ...] = ()
    lsb_at_0g: tuple[float, ...] = ()
    rate_hz: float | None = None
    drop_bad_stamps: bool = False
    mounting: Mounting | None = None

    @property
    def changes_columns(self) -> bool:
        """Return whether the columns of a table are converted."""
        return self != ReadingOptions(topic=self.topic, mounting=self.mounting)


AS_IT_IS = ReadingOptions()
"""Nothing is replaced."""
