# SPDX-License-Identifier: Apache-2.0

"""
What samples show without a model: rests, block statistics, limits of noise, the filter.

Read them in this order:

rests
    block_statistics      short blocks of a stream: mean and variance
    rest_limits           what noise explains at rest
    rest_search           rests among blocks
    rest_detection        rests of a recording or a live stream
    rest_means            their means, with standard deviations
gravity and axes at rest
    tolerances            by how much a sound sensor may be off
    reading_units         units in place of m/s²
    gravity_at_rest       the length of gravity, and what explains another one
    polarity              axes that are inverted or swapped
    stage_angles          whether the angles of a stage explain the output, and in which unit
    axis_ranges           axes at the end of their range, or stuck
    neighbouring_samples  repeated, interleaved, wrapped and single wrong samples
    gyroscope_at_rest     the bias of a gyroscope
    gyroscope_turns       whether a gyroscope agrees with gravity
noise
    allan_deviation       of a stream of any length
    noise_fit             white noise, bias instability and random walk, with intervals
    filter_noise          the filter of a sensor by its noise
    noise_parameters      noise of a recording, and the sensor that has it
    noise_report          for people
a recording as a whole
    recorded_gravity      the look at gravity while a recording is read
    recorded_sensor       its parameter file, and what is measured in its place
    recording_contents    stamps, axes, rests, references and gyroscope
    findings              faults, remarks, and what can be done with it
    findings_text         the sentences on stamps
    findings_report       screen, page and JSON
    gate                  what became worse from one recording to another
"""
