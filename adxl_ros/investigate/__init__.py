# SPDX-License-Identifier: Apache-2.0

"""A diagnosis that chooses and commands what is recorded next; free of ROS."""
