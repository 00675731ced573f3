# SPDX-License-Identifier: Apache-2.0

"""The ROS 2 nodes: thin, and the only place that imports rclpy."""

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
