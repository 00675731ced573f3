# SPDX-License-Identifier: Apache-2.0

"""What the table of a fleet shows: populations, trends, outliers, and their page."""
