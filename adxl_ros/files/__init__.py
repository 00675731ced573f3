# SPDX-License-Identifier: Apache-2.0

"""Recordings, parameter files and journals on disk."""
