# SPDX-License-Identifier: Apache-2.0

"""What nodes draw in a terminal, without rclpy: the calibration screen, the steps of a job."""
