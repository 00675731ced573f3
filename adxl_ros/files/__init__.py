# SPDX-License-Identifier: Apache-2.0

"""
Recordings, parameter files and journals on disk.

Read them in this order:

what a recording is
    recording_columns  samples by column, stamps, references
    stream_info        what a stream states of its sensor
    recording          recordings of any format, read and written
    stamps             the rate of stamps
    stamp_check        stamps that do not increase
    reference_track    a reference at the stamps of samples
    surroundings       temperature and supply
    robot_readings     joints and base of a robot
tables
    tables             delimited text, NumPy, MATLAB, Parquet, logs of PX4
    csv_file           text, in blocks; CSV files, written
    column_mapping     columns, units and mounting, as a user states them
    table_stamps       the stamps of rows
    mapped_recording   a table as a recording
    mapping_proposal   the mapping that an unknown table most likely needs
bags
    cdr                ROS messages as arrays
    imu_message        one serialized Imu
    bag_messages       the messages of a bag
    bag_reader         a bag as a recording
    bag_writer         a recording, or live messages, as a bag
calibrations
    atomic_write       whole files, or none
    parameter_file     the file of a sensor
    calibration_store  its calibrations by date
    sweep_journal      records of poses
    exports            formats of estimators and simulators
"""
