# SPDX-License-Identifier: Apache-2.0

"""Where a sim-to-real gap lies, which effect causes it, how far it shrinks."""
