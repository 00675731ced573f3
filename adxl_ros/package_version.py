# SPDX-License-Identifier: Apache-2.0
"""Version of the installed package."""

from importlib.metadata import PackageNotFoundError, version


def package_version() -> str:
    """Return the version of this package; 'unknown' when it runs from its source."""
    try:
        return version('adxl_ros')
    except PackageNotFoundError:
        return 'unknown'
