# SPDX-License-Identifier: Apache-2.0

"""
The front door: each verb of the package as one call, from recordings to a result.

`import adxl_ros` gives them. A verb takes recordings and a sensor, and returns a dataclass that
prints, draws and saves itself. Tools, fleet, monitor and investigation call the same verbs.
"""
