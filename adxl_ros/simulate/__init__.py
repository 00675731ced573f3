# SPDX-License-Identifier: Apache-2.0

"""
The sensor forward in time: manoeuvres, the chain over time, recordings followed.

Read them in this order:

motions
    motion           joints and surroundings over time
    trajectories     manoeuvres by name
    smoothed_path    smooth paths through readings
    recorded_motion  the motion of a recording
    robot            the force in a frame of a robot
the chain over time
    response         samples during a motion
    simulated_stage  a stage that follows commands
    sensor_model     the chain as a call for simulators
    gyroscope_model  the same of a gyroscope
    host_arrays      arrays of any library
"""
