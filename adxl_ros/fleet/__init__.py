# SPDX-License-Identifier: Apache-2.0

"""
Many recordings of many units: inputs, staging, tasks, the table of their results, and its page.

A task takes the address of a recording and returns one row. It runs in a process of this machine
or on a cluster, and needs no ROS.
"""
