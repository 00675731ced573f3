# SPDX-License-Identifier: Apache-2.0

"""
What a sensor is: a chain of effects, run forward and backward.

Read them in this order:

the sensor
    constants              shared by the whole package
    sensor                 nominal values, effects and provenance
    effects/base           what an effect is
    effects/stage          effects of the references of a motion
    effects/accelerometer  from the force to the input of the ADC
    effects/adc            ADC, link, clock and noise
    signal_chain           the effects in order, forward, and backward at rest
    kinematics             force by the angles of the stage, and tilt by force
    filters                continuous-time filters
    gyroscope              the gyroscope beside it
its errors
    noise                  noise of samples
    covariance             of the force of samples
    error_sizes            root mean squares
    population             a fleet as a prior
    gauss_newton           the iteration that fits share
"""
