# SPDX-License-Identifier: Apache-2.0
"""The accelerometer that a simulator simulates, against the joints that it simulates."""
