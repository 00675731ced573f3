# SPDX-License-Identifier: Apache-2.0
"""
Nine parameters by plain least squares, as imucal and others calibrate.

Zero-g and scale factor of each axis, and three angles between them. It names what differs from 0
by three standard errors, which are those of independent noise.
"""

from adxl_ros_validation.benchmark.case import Case, Finding, linear_fit

_EFFECTS = ('bias', 'scale_factor', 'misalignment')
_SIGNIFICANT = 3.0
"""Standard errors from which a parameter counts; chosen: usual."""


def method(case: Case) -> Finding:
    """Fit all nine, and name those that are significant."""
    tangents = case.tangents(_EFFECTS)
    # One angle for each pair of axes: the others are a rotation, which gravity does not show.
    angles = [name for name in tangents if name.effect == 'misalignment']
    for name in angles[len(case.parameters.axes) :]:
        del tangents[name]
    fit = linear_fit(case, tangents)
    causes = {name.effect for name, z in fit.z.items() if abs(z) > _SIGNIFICANT}
    return Finding(frozenset(causes), 0.997, case.with_changes(fit.changes))
