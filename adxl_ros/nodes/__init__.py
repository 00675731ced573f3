# SPDX-License-Identifier: Apache-2.0

"""
The ROS 2 nodes: thin, and the only place that imports rclpy.

Read them in this order:

what all nodes share
    run_node            start, end, errors and help
    parameters          each declared once
    parameter_checks    unknown ones are refused
    params_files        where one is stated
    sensor_parameters   those of a sensor
    topics              publishers, subscriptions and diagnostics
the live stream
    driver              samples of a link as acceleration
    link_reader         its thread
    sample_output       its topics
    mounting            the case on the robot
    compensation        the stream, corrected
    monitor             the stream beside its prediction
calibrations
    stage               simulated, or the bridge to a real one
    calibration         the guided calibration
    calibration_screen  its screen on a topic
    screen              that screen in a terminal
    keep_calibrated     a robot at work
    investigate         a diagnosis that moves the stage
many nodes at once
    launch_nodes        what launch files share
    jobs                nodes in processes of their own
    demo                a simulated sweep
"""

from pathlib import Path
import sys

from adxl_ros.process import end_silently_while_loading, use_one_thread

end_silently_while_loading()
use_one_thread()
try:
    import rclpy  # noqa: F401
    import sensor_msgs.msg  # noqa: F401
except ImportError as error:
    raise SystemExit(
        f'{Path(sys.argv[0]).name}: the nodes need ROS 2, but {error}; source its '
        'setup.bash, or start the node by ./run'
    ) from None
