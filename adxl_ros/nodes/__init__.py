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

"""The ROS 2 nodes: thin, and the only place that imports rclpy."""

from pathlib import Path
import sys

from adxl_ros.blas_threads import use_one_thread
from adxl_ros.interrupt import end_silently_while_loading

end_silently_while_loading()
use_one_thread()
try:
    import rclpy  # noqa: F401
    import sensor_msgs.msg  # noqa: F401
except ImportError as error:
    raise SystemExit(f'{Path(sys.argv[0]).name}: the nodes need ROS 2, but {error}; source its '
                     'setup.bash, or start the node by ./run') from None
