from .devices import OPENMPD, SONICSURFACE, Device
from .emulator import EmulatedBench, EmulatedSensor
from .link import Link, open_link
from .objective import HardwareObjective
from .sensor import Sensor
from .usb import LinkError, Port

__all__ = [
    "OPENMPD",
    "SONICSURFACE",
    "Device",
    "EmulatedBench",
    "EmulatedSensor",
    "HardwareObjective",
    "Link",
    "LinkError",
    "Port",
    "Sensor",
    "open_link",
]
