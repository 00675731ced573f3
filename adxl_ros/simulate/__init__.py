# SPDX-License-Identifier: Apache-2.0

"""The sensor forward in time: manoeuvres, the chain over time, recordings followed."""
