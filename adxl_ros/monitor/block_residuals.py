# SPDX-License-Identifier: Apache-2.0

"""Samples minus their prediction from the reference, in blocks of a second."""

from __future__ import annotations

from dataclasses import dataclass, replace

from adxl_ros.diagnose.comparison import noiseless
from adxl_ros.model import noise
from adxl_ros.model.constants import MAD_TO_STD
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Need, Place
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.monitor.reference_stream import BlockMotion, ReferenceKind, ReferenceStream
from adxl_ros.simulate.response import Response
import numpy as np

_OUTLIER = 6.0
"""Distance from the median, in standard deviations, from which a sample does not count in the mean
of a block. Chosen: one of 10⁹ samples of normal noise."""
_PARTS = 10
"""Most parts of a block. Chosen: a part of 0.1 s holds many time constants of a usual filter, and
a step is in one part."""
_FEWEST_OF_PART = 8
"""Fewest samples of a part; chosen: its variance is then known within a factor of two."""
_SMALLEST_MPS2 = 1e-9
"""Smallest standard deviation of a block, m/s²; a simulated sensor may have no noise."""


@dataclass(frozen=True)
class Block:
    """The comparison of one block; m axes."""

    end_ns: int  # End of the block, ns
    mean_mps2: np.ndarray  # Mean of the residual without outliers, m/s², (m,)
    square: np.ndarray  # Mean square of the residual, (m/s²)², (m,)
    # Mean square about the mean, with its lost degrees of freedom, (m/s²)², (m,)
    noise_square: np.ndarray
    # Logarithm of the standard deviation within short parts of the block, (m,): a step of the mean
    # hardly changes it
    log_noise: np.ndarray
    # Mean square of the residual to the sensor without effects, (m/s²)², (m,)
    datasheet_square: np.ndarray
    # Mean square of the force by the steps of an encoder, (m/s²)², (m,)
    reference_square: np.ndarray
    moves: bool  # Whether the reference moves


class Prediction:
    """The output of a sensor on the reference, from block to block."""

    def __init__(self, sensor: Sensor, reference: ReferenceStream) -> None:
        stage = [name for name in sensor.effects if _needs_stage(name)]
        # Effects that need the angles of a stage, which the reference has not
        self.left_out = tuple(stage) if reference.kind is ReferenceKind.IMU else ()
        effects = tuple(name for name in sensor.effects if name not in self.left_out)
        self._sensor, self._reference = sensor, reference
        self._modelled = noiseless(replace(sensor, effects=effects))
        self._datasheet = noiseless(replace(sensor, effects=(), values={}))
        self._responses: tuple[Response, Response] | None = None
        self._origin_ns = 0

    def restart(self) -> None:
        """Let the next block be the first one."""
        self._responses = None

    @property
    def is_running(self) -> bool:
        """Return whether a block has been predicted since the last start."""
        return self._responses is not None

    def start(self, begin_ns: int) -> None:
        """Put the sensors, settled, at the begin of a block, ns; it is to be prepared then."""
        self._origin_ns = begin_ns
        self._motion = self._reference.motion(begin_ns)

    def block(self, stamp_ns: np.ndarray, accel_mps2: np.ndarray, motion: BlockMotion,
              end_ns: int) -> Block:
        """
        Compare the samples of one prepared block.

        stamp_ns: stamps, ns, (n,); accel_mps2: samples by nominal conversion, m/s², (n, m).
        """
        if self._responses is None:
            self._responses = (Response(self._modelled, self._motion, 0),
                               Response(self._datasheet, self._motion, 0))
        time_s = (stamp_ns - self._origin_ns) * 1e-9
        modelled, datasheet = (accel_mps2 - to_nominal_mps2(respond(time_s), self._sensor)
                               for respond in self._responses)
        mean_mps2 = _clean_mean(modelled)
        count = len(stamp_ns)
        independent = float(noise.effective_samples(count, 1 / self._sensor.rate_hz,
                                                    self._sensor.rc_s))
        freedom = max(1 - 1 / max(independent, 1.0), 0.5)
        return Block(
            end_ns, mean_mps2, (modelled ** 2).mean(axis=0),
            modelled.var(axis=0) / freedom + _SMALLEST_MPS2 ** 2, _log_noise(modelled),
            (datasheet ** 2).mean(axis=0), motion.error_mps2[:len(mean_mps2)] ** 2, motion.moves)


def _needs_stage(name: str) -> bool:
    """Return whether an effect needs the angles of a stage."""
    effect = effect_named(name)
    return effect.place is Place.STAGE or Need.STAGE in effect.needs


def _log_noise(residual: np.ndarray) -> np.ndarray:
    """Return the log of the median standard deviation of parts of columns, (n, m), (m,)."""
    parts = np.array_split(residual, max(min(_PARTS, len(residual) // _FEWEST_OF_PART), 1))
    variances = np.median([part.var(axis=0) for part in parts], axis=0)
    return np.asarray(0.5 * np.log(variances + _SMALLEST_MPS2 ** 2))


def _clean_mean(residual: np.ndarray) -> np.ndarray:
    """Return the means of columns, (n, m), without outliers, (m,)."""
    centre = np.median(residual, axis=0)
    distance = np.abs(residual - centre)
    limit = _OUTLIER * MAD_TO_STD * np.median(distance, axis=0) + _SMALLEST_MPS2
    counts = distance <= limit
    return np.asarray((residual * counts).sum(axis=0) / counts.sum(axis=0))
