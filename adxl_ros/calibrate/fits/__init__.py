# SPDX-License-Identifier: Apache-2.0

"""The fits: linear, the paper's regression, the full model, gravity."""
