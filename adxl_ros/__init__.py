# SPDX-License-Identifier: Apache-2.0

"""
Driver, calibration, compensation and diagnosis of low-g analog MEMS accelerometers.

The verbs of the package load when they are used, and need no ROS:

    import adxl_ros as adxl
    recording = adxl.read('sweep.csv')
    fit = adxl.fit(recording, 'adxl203')
    corrected = adxl.apply(recording, fit)
    gap = adxl.diagnose(recording, fit)
"""

from collections.abc import Callable
from importlib import import_module
import sys
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from adxl_ros.api.calibration import Fit, fit
    from adxl_ros.api.checking import Check, check
    from adxl_ros.api.correction import apply, Corrected
    from adxl_ros.api.gap import diagnose, Gap
    from adxl_ros.api.noise import Noise, noise
    from adxl_ros.api.recordings import from_arrays, read
    from adxl_ros.api.sensors import load
    from adxl_ros.api.simulation import simulate
    from adxl_ros.api.updating import Update, update
    from adxl_ros.errors import UserError
    from adxl_ros.files.recording_columns import Recording
    from adxl_ros.model.sensor import Sensor
    from adxl_ros.simulate.sensor_model import SensorModel

_MODULES = {
    'apply': 'api.correction',
    'check': 'api.checking',
    'diagnose': 'api.gap',
    'fit': 'api.calibration',
    'from_arrays': 'api.recordings',
    'load': 'api.sensors',
    'noise': 'api.noise',
    'read': 'api.recordings',
    'simulate': 'api.simulation',
    'update': 'api.updating',
    'Check': 'api.checking',
    'Corrected': 'api.correction',
    'Fit': 'api.calibration',
    'Gap': 'api.gap',
    'Noise': 'api.noise',
    'Recording': 'files.recording_columns',
    'Sensor': 'model.sensor',
    'SensorModel': 'simulate.sensor_model',
    'Update': 'api.updating',
    'UserError': 'errors',
}
"""Module of each name that `import adxl_ros` gives: verbs, types of their results, the error."""

__all__ = [
    'Check',
    'Corrected',
    'Fit',
    'Gap',
    'Noise',
    'Recording',
    'Sensor',
    'SensorModel',
    'Update',
    'UserError',
    'apply',
    'check',
    'diagnose',
    'fit',
    'from_arrays',
    'load',
    'noise',
    'read',
    'simulate',
    'update',
]


class _Verb:
    """
    A verb that has a package of the same name, and stands for it in `sys.modules`.

    Both stay what they are in any order of imports: `adxl_ros.diagnose(...)` as well as
    `import adxl_ros.diagnose.verdict`. It is no module, so that `help` shows the verb.
    """

    def __init__(self, verb: str) -> None:
        # Spec and path, by which the modules of the package are found
        vars(self).update(vars(import_module(f'{__name__}.{verb}')))
        self._verb = self.__qualname__ = verb

    @property
    def __wrapped__(self) -> Callable[..., Any]:
        """Return the verb, for its signature."""
        return getattr(import_module(f'{__name__}.{_MODULES[self._verb]}'), self._verb)

    @property
    def __doc__(self) -> str | None:  # type: ignore[override]
        return self.__wrapped__.__doc__

    def __get__(self, instance: object, owner: object = None) -> Callable[..., Any]:
        """Return the verb; by this method `inspect` and `help` know it as a routine."""
        return self.__wrapped__

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self.__wrapped__(*arguments, **named)

    def __repr__(self) -> str:
        return repr(self.__wrapped__)

    def __reduce__(self) -> str:
        """Pickle it by its name, as functions are."""
        return self._verb


for _name in ('diagnose', 'simulate'):
    globals()[_name] = _Verb(_name)
    sys.modules[f'{__name__}.{_name}'] = globals()[_name]


def __getattr__(name: str) -> Any:
    """Load a verb when it is used first."""
    if name == '__version__':
        from adxl_ros.process import package_version

        return package_version()
    if name not in _MODULES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    globals()[name] = value = getattr(import_module(f'{__name__}.{_MODULES[name]}'), name)
    return value


def __dir__() -> list[str]:
    """Return what the package gives, loaded or not, without what it is made of."""
    return [*__all__, '__version__', '__doc__', '__name__', '__path__']
