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

"""Every kind of fault of this world, in one table."""

from __future__ import annotations

from adxl_ros.blind.world import element_faults, noise_faults, stage_faults, unlisted_faults

KINDS = {kind.name: kind for kind in (*stage_faults.KINDS, *element_faults.KINDS,
                                      *noise_faults.KINDS, *unlisted_faults.KINDS)}
"""All kinds by name. Their order is part of a seed: do not change it."""
KNOWN = tuple(name for name, kind in KINDS.items() if kind.in_library)
"""Kinds of which the package's library has an effect of the same name."""
UNLISTED = tuple(name for name, kind in KINDS.items() if not kind.in_library)
"""Kinds of which the package's library has no effect."""
