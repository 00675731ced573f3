# SPDX-License-Identifier: Apache-2.0

"""What the links share: clocks, counters, wire format, port, an emulated board."""
