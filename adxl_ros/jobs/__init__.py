# SPDX-License-Identifier: Apache-2.0

"""
Many tasks in parallel: pools of processes or a Dask cluster, retries, and small whole files.

Nothing in it knows what a task computes.
"""
