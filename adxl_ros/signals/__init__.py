# SPDX-License-Identifier: Apache-2.0

"""What samples show without a model: rests, block statistics, limits of noise, the filter."""
