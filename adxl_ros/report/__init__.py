# SPDX-License-Identifier: Apache-2.0

"""Numbers with units, pages and figures: the only place that formats."""
