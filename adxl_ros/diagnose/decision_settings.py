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

"""The settings of the decision: priors, factors and limits, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DecisionSettings:
    """
    Priors, factors and limits of the decision; docs/diagnosis.md gives the source of each.

    Attributes
    ----------
    prior_by_count
        Prior probability of sets of 0, 1, 2 and 3 effects, spread over the sets of that size.
        Chosen: the mix of the blind check.
    prior_of_unknown_by_count
        The same of sets beside which something unknown acts, spread over the dimensions too.
        Chosen: as above.
    evidence_factor
        Factor of the log evidence, because no model of a sensor is exact (Miller and Dunson
        2019). Tuned on working cases of the package's own simulator, where 0.05 to 0.3 differ
        little.
    worth_fitting
        Log Bayes factor from which a further effect is fitted, and from which a drift counts on
        held-out blocks. Derived: times `evidence_factor` it is below the prior odds of a further
        effect.
    smallest_deficit, deficit_share
        A hypothesis is hopeless if its log evidence is below that of the best one by more than
        both the deficit and this share of what the best one gains over no gap. It is neither
        refined nor compared. Chosen: such a hypothesis would need a form error that explains a
        tenth of the gap.
    beside_drift
        What a further effect beside a drift must gain in log evidence, because no drift has
        exactly the spectrum of the model at the lowest frequencies. Tuned by hand on simulated
        recordings of the working seeds of the blind check.
    form_errors
        Shares of an effect's size that its form may differ by; they are equally probable.
    unknown_amplitudes_g
        Rms of an unknown function, g; they are equally probable. Chosen: from a tenth of the
        noise of a quiet sensor to the largest drift of its zero-g.
    with_unknown
        Number of the most probable sets beside which unknown functions are tried. Chosen: run
        time.
    smallest_share_of_noise
        An effect is immaterial below this share of the rms of the noise.
    smallest_share_of_gap
        An effect is immaterial below this share of the rms of all effects whose form is not
        exact. Between 1 and 15 % its value matters little.
    smallest_share_of_lost_motion
        An effect of the sensor whose form is not exact is immaterial below this share of the rms
        of motion that a smooth reference lacks, and what is unknown or unexplained is then an
        error of the reference. Chosen: such a reference has errors in slower motion, too.
    smallest_drift_share_of_gap
        The same for a drift, because what the form of an effect lacks comes and goes like a
        drift.
    smallest_unknown_share
        An unknown function is an error of form below this share of the rms of the effects that
        have one. Chosen: the middle of `form_errors`.
    calibration_factor
        Beside another effect, zero-g and scale factor matter above this multiple of what the
        calibration can have taken up. Chosen: two standard deviations.
    healthy_factor
        They also exceed this multiple of the tolerance of a healthy unit. Chosen: one unit in 400.
    smallest_rival_share
        Smallest probability of an inseparable rival, divided by that of the best set. Chosen:
        odds of 10 to 1.
    imitated_deficit
        Largest deficit of log evidence of an effect of the reference below the effect of the
        sensor that gives the same samples. Chosen: their priors differ, the samples do not.
    certain
        Probability of something unknown from which the verdict is unknown. Chosen: more likely
        than not.
    wrong_by_count, wrong_unknown
        Share of verdicts that are wrong for a reason that no hypothesis describes: of those with
        0, 1, 2, and 3 or more effects, and of unknown. Rounded from 21 working cases with
        distorted forms (seed 1) and 38 recordings of another simulator: 0 of 6, 3 of 14, 2 of 26,
        3 of 3, and 4 of 10 were wrong.
    unexplained_share_of_explained, unexplained_share_of_noise
        An unexplained rms above both shares of the explained rms and of the noise is unknown.
        They find what no dimension shows, such as a line of the spectrum.
    walk_log_bayes_factor
        Log Bayes factor of octaves with another power than a random walk's, above which the drift
        is unknown.

    """

    prior_by_count: tuple[float, ...] = (0.30, 0.35, 0.13, 0.02)
    prior_of_unknown_by_count: tuple[float, ...] = (0.15, 0.04, 0.01, 0.001)
    evidence_factor: float = 0.3
    worth_fitting: float = 16.0
    smallest_deficit: float = 300.0
    deficit_share: float = 0.1
    beside_drift: float = 25.0
    form_errors: tuple[float, ...] = (0.0, 0.1, 0.3, 0.6)
    unknown_amplitudes_g: tuple[float, ...] = (1e-4, 3e-4, 1e-3, 3e-3)
    with_unknown: int = 6
    smallest_share_of_noise: float = 0.03
    smallest_share_of_gap: float = 0.1
    smallest_share_of_lost_motion: float = 0.5
    smallest_drift_share_of_gap: float = 0.3
    smallest_unknown_share: float = 0.3
    calibration_factor: float = 2.0
    healthy_factor: float = 3.0
    smallest_rival_share: float = 0.1
    imitated_deficit: float = 50.0
    certain: float = 0.5
    wrong_by_count: tuple[float, ...] = (0.05, 0.2, 0.1, 0.6)
    wrong_unknown: float = 0.35
    unexplained_share_of_explained: float = 0.7
    unexplained_share_of_noise: float = 0.5
    walk_log_bayes_factor: float = 30.0
