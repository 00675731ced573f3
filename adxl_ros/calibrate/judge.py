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

"""Whether a calibration passes: against the datasheet, against the noise, and what limits it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.calibrate.limits import milli_g, own_noise_mps2, Parts
from adxl_ros.calibrate.verdict import NINETY, rms_interval, Score
from adxl_ros.model.coefficients import get, parameter_of
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
import numpy as np

PASS, FAIL, NOT_SHOWN = 'PASS', 'FAIL', 'NOT SHOWN'
_LINEARITY = 'nonlinearity.cubic_per_g2'


@dataclass(frozen=True)
class Judged:
    """
    One model beside what it could be.

    Attributes
    ----------
    model
        Its name.
    accel, tilt
        What its errors are made of, (m/s²)² an axis and rad².
    datasheet, noise
        PASS, FAIL or NOT SHOWN; empty where the parameter file has no such figure.
    limit
        'noise', 'stage', 'model' or 'stage or model'.

    """

    model: str
    accel: Parts
    tilt: Parts
    datasheet: str
    noise: str
    limit: str

    @property
    def own_mg(self) -> float:
        """Return what the calibration itself errs by, mg rms over the axes."""
        return milli_g(self.accel.own)

    @property
    def own_deg(self) -> float:
        """Return what it errs by in tilt, deg rms; NaN where no pose shows it."""
        return float(np.degrees(np.sqrt(self.tilt.own)))


def judge(model: str, accel: Parts, tilt: Parts, sensor: Sensor) -> Judged:
    """
    Judge one model by what it errs by itself, noise and stage of the check taken out.

    Against the datasheet: no more than the nonlinearity at full scale that the maker calls
    typical, the only error that his own calibration leaves. Against the noise: no more than that
    of one sample, rms over the axes. An error whose 90 % interval reaches beyond the bar is not
    shown to keep it.
    """
    bar = linearity_mps2(sensor)
    limit = accel.limit
    if not accel.apart and max(accel.model, accel.fit) > max(accel.noise, accel.stage):
        limit = 'stage or model'
    return Judged(model, accel, tilt, _against(accel, bar) if bar else '',
                  _against(accel, own_noise_mps2(sensor)), limit)


def _against(accel: Parts, bar_mps2: float) -> str:
    sure = accel.own if accel.apart else accel.fit
    if sure > bar_mps2 ** 2:
        return FAIL
    return PASS if accel.own_most <= bar_mps2 ** 2 else NOT_SHOWN


def linearity_mps2(sensor: Sensor) -> float:
    """Return the typical nonlinearity at full scale by the datasheet, m/s²; 0 if not stated."""
    typical, _ = sensor.datasheet.get(_LINEARITY, (0.0, 0.0))
    return typical * sensor.range_g ** 3 * G0_MPS2


def beyond_datasheet(sensor: Sensor) -> list[str]:
    """Name the coefficients whose whole 90 % interval is beyond the datasheet's greatest."""
    found = []
    std = np.sqrt(np.diag(sensor.covariance))
    for name, value, s in zip(sensor.covariance_names, get(sensor, sensor.covariance_names), std):
        _, most = sensor.datasheet.get('.'.join(name.split('.')[:2]), (0.0, 0.0))
        if most and abs(value) - NINETY * s > most:
            found.append(f'{name} is {value:.4g} +- {NINETY * s:.2g} {parameter_of(name).unit}, '
                         f'beyond {most:g}')
    return found


def table(judged: Sequence[Judged], scores: Sequence[Score]) -> list[str]:
    """Lay the verdicts out for a terminal; models are those of `scores`."""
    lines = [f'{"verdict":9} {"tilt rms (90 %) deg":>23} {"accel rms (90 %) mg":>23}  '
             f'{"own mg":>7}  {"datasheet":9} {"noise":9} limited by']
    of = {score.model: score for score in scores}
    for one in judged:
        score = of[one.model]
        lines.append(
            f'{one.model:9} {_interval(score.tilt_rms_deg, score.intervals["tilt"])} '
            f'{_interval(score.accel_rms_mg, score.intervals["accel"])}  '
            f'{one.own_mg:7.3f}  {one.datasheet or "-":9} {one.noise:9} '
            f'{one.limit}')
    return lines


def words(judged: Judged, sensor: Sensor) -> list[str]:
    """Say what the bars are, and what the errors of the model that was taken are made of."""
    accel = judged.accel
    bar = linearity_mps2(sensor)
    lines = ['own: what the calibration itself errs by, noise and stage of the check taken out; '
             + (f'at most {1e3 * bar / G0_MPS2:.2g} mg by the datasheet (typical nonlinearity at '
                'full scale), ' if bar else 'no bar by a datasheet, ')
             + f'{1e3 * own_noise_mps2(sensor) / G0_MPS2:.2g} mg by the noise of one sample']
    made = ', '.join(f'{name} {milli_g(getattr(accel, name)):.3f}'
                     for name in ('noise', 'stage', 'fit', 'model'))
    turned = '' if np.isnan(judged.own_deg) else \
        f'; its own tilt error is {judged.own_deg:.3f} deg rms'
    if judged.model == 'gravity':
        # The fit's part is of all directions, and what was seen a magnitude.
        lines.append(f'gravity: noise of the means {milli_g(accel.noise):.3f} mg, what nine '
                     f'parameters leave {milli_g(accel.model):.3f} mg, the fit, each direction, '
                     f'{milli_g(accel.fit):.3f} mg{turned}')
    else:
        lines.append(f'{judged.model}: {milli_g(accel.seen):.3f} mg are {made} in '
                     f'squares{turned}')
    if not accel.apart:
        lines.append('no pose was visited twice: stage and model are not told apart')
    if sensor.datasheet:
        beyond = beyond_datasheet(sensor)
        lines.append(f'unit within {sensor.datasheet_name or "its datasheet"}: '
                     + (f'{FAIL}: {"; ".join(beyond)}' if beyond else PASS))
    return lines


def gravity_line(judged: Judged, left_out_mps2: np.ndarray) -> str:
    """Lay out the verdict of a calibration against gravity, whose only figure is a magnitude."""
    mg = left_out_mps2 / G0_MPS2 * 1e3
    low, high = rms_interval(mg)
    return (f'verdict: rests left out {np.sqrt(np.mean(mg ** 2)):.3f} ({low:.3f} to {high:.3f}) '
            f'mg rms, {np.abs(mg).max():.3f} max; datasheet {judged.datasheet or "-"}, noise '
            f'{judged.noise}; limited by the {judged.limit}')


def figures(judged: Judged | None, scores: Sequence[Score]) -> dict[str, str]:
    """Return the figures of the model that was taken for the provenance; NaN are left out."""
    if judged is None:
        return {}
    found = {'own_accel_mg': judged.own_mg,
             'own_tilt_deg': judged.own_deg}
    for score in scores:
        if score.model == judged.model:
            found |= {'held_out_poses': score.poses, 'held_out_tilt_rms_deg': score.tilt_rms_deg,
                      'held_out_tilt_max_deg': score.tilt_max_deg,
                      'held_out_accel_rms_mg': score.accel_rms_mg,
                      'held_out_accel_max_mg': score.accel_max_mg}
    return {**{key: f'{value:.4g}' for key, value in found.items() if np.isfinite(value)},
            **({'verdict_datasheet': judged.datasheet} if judged.datasheet else {}),
            'verdict_noise': judged.noise, 'limited_by': judged.limit}


def _interval(rms: float, ends: tuple[float, float]) -> str:
    if np.isnan(rms):
        return f'{"-":>23}'
    return f'{f"{rms:.3f} ({ends[0]:.3f} to {ends[1]:.3f})":>23}'
