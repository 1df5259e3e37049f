"""Airborne-ultrasound foci behind obstacles: scenes, simulation, phase optimisation.

Every public name is listed in ``__init__.pyi`` and imported when it is first used, so that
``import autdtorch`` is quick and loads no simulation, plotting or optimisation package.
"""

import sys
import warnings

if sys.version_info < (3, 11):  # noqa: UP036 - from a clone, or installed by force
    raise ImportError(f"autdtorch needs Python 3.11 or later; this is {sys.version.partition(' ')[0]}")

from autdtorch.utils.hints import lazy_names

__version__ = "0.1.0"

_load, __dir__, __all__ = lazy_names(__name__, __file__)

#: Names of version 0.1 that were renamed since, and their names now.
_RENAMED = {
    "Dead": "FailedTransducers",
    "ScatteringBodies": "TMatrixCluster",
    "ScatteringOperator": "TMatrix",
    "reference": "analytic",
}


def __getattr__(name: str) -> object:
    """Import a public name when it is first used."""
    if name not in _RENAMED:
        return _load(name)
    warnings.warn(f"autdtorch.{name} is now autdtorch.{_RENAMED[name]}", DeprecationWarning, stacklevel=2)
    return _load(_RENAMED[name])
