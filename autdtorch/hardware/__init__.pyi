from .adapters import Adapter
from .autd3 import open_autd3
from .devices import OPENMPD, SONICSURFACE, ULTRAINO, Device, openmpd_boards, ultraino_boards
from .emulator import EmulatedBench, EmulatedSensor
from .link import Link, open_link
from .objective import HardwareObjective
from .sensor import Sensor
from .usb import LinkError, Port

__all__ = [
    "OPENMPD",
    "SONICSURFACE",
    "ULTRAINO",
    "Adapter",
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
    "openmpd_boards",
    "ultraino_boards",
]
