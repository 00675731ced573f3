# SPDX-License-Identifier: Apache-2.0
"""The blind check of the diagnosis: a world of its own, sealed labels, and scores."""
