"""Airborne-ultrasound foci behind obstacles: scenes, simulation, phase optimisation.

Every public name is listed in ``__init__.pyi`` and imported when it is first used, so that
``import autdtorch`` is quick and loads no simulation, plotting or optimisation package.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
