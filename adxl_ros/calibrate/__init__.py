# SPDX-License-Identifier: Apache-2.0

"""
From rests to coefficients: poses, fits, guided calibration and report.

Read them in this order:

poses
    poses                    the mean output at rest, with angles
    recorded_poses           from the rests of a recording
    joint_settings           poses between which a joint did not move
    pose_model               what a sensor should put out in poses
the calibration
    calibration              fit, assessment, provenance: the stages below
    result                   the result, and its comparison with others
fits
    fits/linear              the paper's: equations 1 to 19
    fits/gravity_fit         nine parameters by the length of gravity
    fits/full_model          all poses, axes and errors of the stage at once
    fits/pose_covariance     the covariance of poses
    fits/linearisation       the fit about its estimate
    fits/term_selection      the terms that poses support
    fits/thermal_fit         zero-g over temperature
    fits/extrapolation       what it lacks outside of its temperatures
    fits/cube_directions     poses by hand
    fits/optimal_poses       the poses that determine most
the report
    report/held_out          errors on poses that a fit has not seen
    report/error_budget      their parts
    report/error_causes      how each part follows
    report/acceptance        PASS or FAIL
    report/gum               uncertainty at a pose, and the certificate
    report/certificate_data  what a certificate states besides
    report/page              the page
the guided calibration
    guided/session           from the first pose to the parameter file
    guided/controller        its states
    guided/guide             what all guides share
    guided/pose_plan         the poses, and checks of one
    guided/stage_guide       a sweep on a stage
    guided/rest_guides       a sensor in the hand
    guided/thermal_guide     a sensor that warms and cools
    guided/running_estimate  the estimate after each pose
    guided/screen_contents   what the screen shows
a robot at work
    keep/prior               what is known before the first rest
    keep/stays               its rests
    keep/belief              the coefficients as Kalman filters
    keep/keeper              when a change is adopted
    keep/update_report       the page
"""
