"""Trials on real arrays: links to devices over USB, sensors, the objective that they make, and an emulator.

Every public name is listed in ``__init__.pyi`` and imported when it is first used: only the emulator and an
open link import pyusb.
"""

from autdtorch.utils.hints import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
