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

from adxl_ros.calibrate.report.cross_validation import rms_interval, Score
from adxl_ros.calibrate.report.error_budget import milli_g, own_noise_mps2, Parts
from adxl_ros.model.coefficients import get, parameter_of
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
import numpy as np

PASS, FAIL, NOT_SHOWN = 'PASS', 'FAIL', 'NOT SHOWN'
_CLOSE = 0.2
_LINEARITY = Coefficient('nonlinearity', 'cubic_per_g2')


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
        Of acceleration: PASS, FAIL or NOT SHOWN; empty where there is no such bar.
    tilt_datasheet, tilt_noise
        Of tilt.
    limit
        'noise', 'stage', 'model' or 'stage or model'.

    """

    model: str
    accel: Parts
    tilt: Parts
    datasheet: str
    noise: str
    limit: str
    tilt_datasheet: str = ''
    tilt_noise: str = ''

    def worst(self, bar: str) -> str:
        """Return the worse of acceleration's and tilt's verdict against `datasheet` or `noise`."""
        both = getattr(self, bar), getattr(self, f'tilt_{bar}')
        return next((one for one in (FAIL, NOT_SHOWN, PASS) if one in both), '')

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
    of one sample, rms over the axes. Tilt: no more than such errors on each axis make of it. An
    error whose 90 % interval reaches beyond the bar is not shown to keep it.
    """
    bars = [bar ** 2 for bar in (linearity_mps2(sensor), own_noise_mps2(sensor))]
    limit = accel.limit
    if not accel.apart and max(accel.model, accel.fit) > max(accel.noise, accel.stage):
        limit = 'stage or model'
    datasheet, noise = (_against(accel, bar) for bar in bars)
    tilted = [_against(tilt, bar * tilt.per_axis) for bar in bars]
    return Judged(model, accel, tilt, datasheet, noise, limit, *tilted)


def _against(parts: Parts, bar: float) -> str:
    if not bar > 0:
        return ''
    sure = parts.own if parts.apart else parts.fit
    if sure > bar:
        return FAIL
    return PASS if parts.own_most <= bar else NOT_SHOWN


def linearity_mps2(sensor: Sensor) -> float:
    """Return the typical nonlinearity at full scale by the datasheet, m/s²; 0 if not stated."""
    typical, _ = sensor.datasheet.get(_LINEARITY, (0.0, 0.0))
    return typical * sensor.range_g ** 3 * G0_MPS2


def beyond_datasheet(sensor: Sensor) -> list[str]:
    """Name the coefficients whose whole 90 % interval is beyond the datasheet's greatest."""
    found = []
    std = np.sqrt(np.diag(sensor.covariance))
    for name, value, s in zip(sensor.covariance_names, get(sensor, sensor.covariance_names), std):
        _, most = sensor.datasheet.get(name.without_axis, (0.0, 0.0))
        if most and abs(value) - Z_90 * s > most:
            found.append(f'{name} is {value:.4g} +- {Z_90 * s:.2g} {parameter_of(name).unit}, '
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
        known = accel.noise + accel.stage + accel.fit + accel.model
        # The fit's covariance may promise more than these poses happened to show, or less.
        chance = '' if abs(known - accel.seen) < _CLOSE * accel.seen else \
            ' (by their covariances: what is seen departs from that by chance)'
        lines.append(f'{judged.model}: {milli_g(accel.seen):.3f} mg seen, of {made} in '
                     f'squares{chance}{turned}')
    if judged.tilt_noise:
        lines.append('tilt, by what such errors of the axes make of it: ' + ', '.join(
            f'at most {_turned_deg(judged, bar):.2g} deg by the {name}: {said}'
            for name, bar, said in (
                ('datasheet', bar, judged.tilt_datasheet),
                ('noise', own_noise_mps2(sensor), judged.tilt_noise)) if said))
    if not accel.apart:
        lines.append('no pose was visited twice: stage and model are not told apart')
    return lines


def _turned_deg(judged: Judged, bar_mps2: float) -> float:
    return float(np.degrees(bar_mps2 * np.sqrt(judged.tilt.per_axis)))


def unit_line(sensor: Sensor) -> list[str]:
    """Say whether the unit itself is what its datasheet promises; nothing without one."""
    if not sensor.datasheet:
        return []
    beyond = beyond_datasheet(sensor)
    return [f'unit within {sensor.datasheet_name or "its datasheet"}: '
            + (f'{FAIL}: {"; ".join(beyond)}' if beyond else PASS)]


def headline(judged: Judged | None, scores: Sequence[Score]) -> list[str]:
    """Say in one line how the model that was taken does, and in one what it errs by."""
    if judged is None:
        return ['not judged: too few poses to hold some of them out']
    against = ', '.join(f'{bar} {worst}' for bar in ('datasheet', 'noise')
                        if (worst := judged.worst(bar)))
    limit = 'stage or model' if judged.limit == 'stage or model' else f'the {judged.limit}'
    lines = [f'{judged.model}: {against}; limited by {limit}']
    for score in scores:
        if score.model == judged.model:
            tilt = '' if np.isnan(score.tilt_rms_deg) else \
                f'tilt {score.tilt_rms_deg:.2g}° rms, {score.tilt_max_deg:.2g}° max; '
            lines.append(f'held out: {tilt}accel {score.accel_rms_mg:.2g} mg rms, '
                         f'{score.accel_max_mg:.2g} mg max')
    return lines


def narrow_table(judged: Sequence[Judged], scores: Sequence[Score]) -> list[str]:
    """Lay the models out in 79 columns, the simplest first; none without scores."""
    of, bars = {one.model: one for one in judged}, f'{"datasheet":9} {"noise":9}'
    lines = [f'{"held out":8} {"tilt rms/max°":>14} {bars} {"mg rms/max":>14} {bars}'.rstrip()]
    for score in scores:
        own = of.get(score.model)
        tilted, accel = [(own.tilt_datasheet, own.tilt_noise), (own.datasheet, own.noise)] \
            if own else [('', '')] * 2
        lines.append(f'{score.model:8} {_pair(score.tilt_rms_deg, score.tilt_max_deg, *tilted)} '
                     f'{_pair(score.accel_rms_mg, score.accel_max_mg, *accel)}'.rstrip())
    return lines if scores else []


def _pair(rms: float, most: float, datasheet: str, noise: str) -> str:
    shown = '-' if np.isnan(rms) else f'{rms:.3f}/{most:.3f}'
    return f'{shown:>14} {datasheet:9} {noise:9}'


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
            'verdict_noise': judged.noise,
            **{f'verdict_tilt_{name}': said for name, said in (
                ('datasheet', judged.tilt_datasheet), ('noise', judged.tilt_noise)) if said},
            'limited_by': judged.limit}


def _interval(rms: float, ends: tuple[float, float]) -> str:
    if np.isnan(rms):
        return f'{"-":>23}'
    return f'{f"{rms:.3f} ({ends[0]:.3f} to {ends[1]:.3f})":>23}'
