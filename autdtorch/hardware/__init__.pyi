from .autd3 import open_autd3
from .devices import OPENMPD, SONICSURFACE, ULTRAINO, Device, openmpd, ultraino
from .emulator import EmulatedBench, EmulatedSensor
from .link import Link, open_link
from .objective import HardwareObjective
from .sensor import Sensor
from .usb import LinkError, Port

__all__ = [
    "OPENMPD",
    "SONICSURFACE",
    "ULTRAINO",
    "Device",
    "EmulatedBench",
    "EmulatedSensor",
    "HardwareObjective",
    "Link",
    "LinkError",
    "Port",
    "Sensor",
    "open_autd3",
    "open_link",
    "openmpd",
    "ultraino",
]
