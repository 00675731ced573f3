# SPDX-License-Identifier: Apache-2.0
"""The diagnosis of this package, by its front door."""

import adxl_ros as adxl
from adxl_ros_validation.benchmark.case import Case, Finding, UNKNOWN


def method(case: Case) -> Finding:
    """Diagnose a recording."""
    gap = adxl.diagnose(case.recording, case.stated, sim=case.reference)
    verdict = gap.to_dict()['verdict']
    causes = frozenset(verdict['effects'])
    if gap.verdict == 'unknown':
        causes |= {UNKNOWN}
    return Finding(
        causes,
        gap.probability,
        gap.sensor,
        [frozenset(group) for group in verdict['groups']],
        gap.verdict,
    )
