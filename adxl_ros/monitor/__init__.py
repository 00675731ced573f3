# SPDX-License-Identifier: Apache-2.0

"""The gap of a running sensor against its prediction, and changes of it; free of ROS."""
