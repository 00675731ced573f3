# SPDX-License-Identifier: Apache-2.0

"""What a sensor is: a chain of effects, run forward and backward."""
