# SPDX-License-Identifier: Apache-2.0

"""The reference: another instrument or simulator that states the specific force."""

from math import cos, sin

from adxl_ros.model.constants import AXES
from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Role, Signals
import numpy as np


def _reference_frame(signals: Signals, p: Parameters) -> None:
    """Turn the force of the reference about its x, then about y, then about z."""
    x, y, z = signals.force
    c, s = cos(p['x_rad']), sin(p['x_rad'])
    y, z = y * c - z * s, y * s + z * c
    c, s = cos(p['y_rad']), sin(p['y_rad'])
    x, z = x * c + z * s, z * c - x * s
    c, s = cos(p['z_rad']), sin(p['z_rad'])
    signals.force = [x * c - y * s, x * s + y * c, z]


REFERENCE_FRAME = Effect(
    name='reference_frame',
    place=Place.REFERENCE,
    parameters=tuple(
        Parameter(f'{axis}_rad', 'rad', -0.5, 0.5, 0.0175,
                  'physics: markers are placed to some 1 deg',
                  f'turn of the specific force about {axis}, from the reference to the sensor', '')
        for axis in AXES),
    apply=_reference_frame,
    exact=True,
    cause='The frame of the reference is turned against that of the sensor; state the rotation, '
          'or align the two.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES, imitated_by='misalignment',
                             proof=(ProofVariable.CROSS_FORCE, ProofVariable.FORCE_Z)),
)
"""Rotation between the frame of the reference and that of the sensor."""


def _reference_delay(signals: Signals, p: Parameters) -> None:
    """Put each sample of the reference earlier than its stamp."""
    signals.time_s = signals.time_s - p['delay_s']


REFERENCE_DELAY = Effect(
    name='reference_delay',
    place=Place.REFERENCE,
    parameters=(
        Parameter('delay_s', 's', 0.0, 1.0, 5e-3, 'physics: filters and transport of a tracker',
                  'delay of the stamps of the reference behind its motion', ''),
    ),
    apply=_reference_delay,
    exact=True,
    cause='The reference is late, or the stamps of the sensor are early; synchronise the clocks, '
          'or state the delay.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SPEEDS, imitated_by='time_offset',
                             proof=(ProofVariable.FORCE_RATE,)),
)
"""Delay of the reference: its stamps are late."""


_ORDER = 3.0
"""Number of equal filters, between a Butterworth filter, 1, and a Gaussian, many. Chosen: the
gains of both are met to 1.4 % rms where they exceed 0.2, and that of a mean to 2 %."""
_MARGIN = 10.0
"""Margin at both ends that the filter runs into, in lengths of its kernel. Chosen: far beyond the
kernel."""


def _reference_filter(signals: Signals, p: Parameters) -> None:
    """Undo a filter of the gain (1 + (ω·σ)^n/6)^(−3), as far as motion is left."""
    step_s = signals.dt_s
    first_s, last_s = float(signals.time_s[0]), float(signals.time_s[-1])
    even_s = first_s + step_s * np.arange(max(round((last_s - first_s) / step_s), 2) + 1)
    count = len(even_s)
    margin = min(round(_MARGIN * p['length_s'] / step_s), count - 2)
    # A transform of such a length is fast.
    size = 1 << (count + 2 * margin - 1).bit_length()
    restoring = _restoring_gain(np.fft.rfftfreq(size, step_s), p) - 1
    for d, stated in enumerate(signals.force):
        even = np.interp(even_s, signals.time_s, stated)
        middle = (even[0] + even[-1]) / 2
        padded = np.pad(even - middle, margin, mode='reflect', reflect_type='odd')
        lacking = np.fft.irfft(np.fft.rfft(padded, size) * restoring, size)
        signals.force[d] = stated + np.interp(signals.time_s, even_s,
                                              lacking[margin:margin + count])


def _restoring_gain(frequency_hz: np.ndarray, p: Parameters) -> np.ndarray:
    """
    Return the complex gain that restores motion, (k,).

    Where the filter passes it is 1/H. Where it leaves less than errors of the reference, nothing
    can be restored, and the gain falls to 0, as that of a Wiener filter.
    """
    relative = (2 * np.pi * frequency_hz * p['length_s']) ** p['steepness']
    log_passed = -_ORDER * np.log1p(relative / (2 * _ORDER))
    passed = np.exp(log_passed)
    restoring = passed / (passed ** 2 + (p['lost_gain'] * (1 - passed)) ** 2)
    if not p['phase']:
        return restoring
    return restoring * np.exp(-1j * p['phase'] * _smallest_phase(log_passed))


def _smallest_phase(log_gain: np.ndarray) -> np.ndarray:
    """Return the phase of a causal filter by the logarithm of its gain, rad, (k,)."""
    cepstrum = np.fft.irfft(log_gain)
    half = len(cepstrum) // 2
    cepstrum[1:half] *= 2
    cepstrum[half + 1:] = 0.0
    return np.fft.rfft(cepstrum).imag[:len(log_gain)]


REFERENCE_FILTER = Effect(
    name='reference_filter',
    place=Place.REFERENCE,
    parameters=(
        Parameter('length_s', 's', 0.0, 0.5, 5e-3,
                  'practice: marker positions are smoothed at 3 to 12 Hz, lengths of 40 to 10 ms',
                  'length σ of the kernel; half of the power is lost near 0.14/σ', '',
                  typical=0.02, starts=(0.003, 0.006, 0.012, 0.025, 0.05)),
        Parameter('steepness', '1', 1.5, 12.0, 2.0,
                  'physics: 2.3 is a Gaussian, 3.2 a Butterworth filter of order 2',
                  'exponent n of the attenuation', '', neutral=2.0, role=Role.SHAPE,
                  starts=(2.3, 4.5)),
        Parameter('lost_gain', '1', 0.1, 0.5, 0.2,
                  'measured: optical tracking against an accelerometer, 0.1 to 0.4',
                  'gain of the filter below which errors of the reference hide the motion', '',
                  neutral=0.2, role=Role.SHAPE, starts=(0.12, 0.35)),
        Parameter('phase', '1', 0.0, 1.0, 1.0,
                  'physics: 0 is smoothed forth and back, 1 while it is recorded',
                  'phase divided by that of a causal filter', '', neutral=1.0, role=Role.SHAPE,
                  starts=(0.0, 1.0)),
    ),
    apply=_reference_filter,
    cause='The reference is smoother than the motion; use it with less smoothing, or compare '
          'slow motion only.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SPEEDS, form=(FormDimension.LAG,),
                             smooths_reference=True, proof=(ProofVariable.FREQUENCY,)),
)
"""Filter of the reference: it is smoother than the motion, as optical tracking is."""
