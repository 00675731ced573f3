# SPDX-License-Identifier: Apache-2.0

"""The sensor backward in time: sample by sample, the RC filter, the paper's inverse."""
