# SPDX-License-Identifier: Apache-2.0

"""
Where a sim-to-real gap lies, which effect causes it, how far it shrinks.

Read them in this order:

the question and its stages
    diagnosis           one call from recordings to a report: the stages below, in order
the recording beside its simulation
    comparison          the baseline on the recorded motion, and the samples that count
    data_faults         what a fault of the data is
    data_checks         the checks in order: corrected, left out or refused
    stamp_checks        stamps that are late or impossible
    motion_shifts       by how much two motions are shifted in time
    simulator_time      the part of a recording that another simulator covers
    reference_checks    time, gravity and dynamics of the reference
    axis_checks         range, unit, sign and order of the axes
    encoder_checks      sign and unit of the angles of a stage
the fit
    noise_floor         below which no model can predict a sample
    noise_filters       make the noise of an axis white
    linear_model        sensitivities of the output to the whole library
    evidence            the probability of samples by a set of columns
    search              singles, pairs and triples of effects
    flexible_functions  what no effect describes
the decision
    held_out            what a set of effects leaves of blocks that it has not seen
    random_drift        whether that drifts at random
    remainder           how much of it flexible functions predict
    weighing            which sets are candidates
    verdict             what is said, and how surely
    verdict_sensor      the sensor with the effects of the verdict
    ideal_observer      how surely anybody could have said it
    noise_effects       effects that show in the noise alone
what a reader is told besides
    gap_closure         the gap before and after
    gap_in_unit         the gap as an angle, a velocity or a function
    residual_map        where the residual lies
    could_show          the smallest effects that would have shown
    next_experiment     what to record next
    self_check          whether the verdict comes back from simulations of it
    proofs              how an effect shows in the recording
    report              words and figures of all outputs
    report_json         `report.json`
    screen              the terminal
    page                the HTML page, and all files
"""
