# SPDX-License-Identifier: Apache-2.0

"""The check of a recording: whether it is sound, and what the tools can do with it."""
