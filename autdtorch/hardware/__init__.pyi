from .devices import OPENMPD, SONICSURFACE, ULTRAINO, Device, openmpd, ultraino
from .emulated_scope import EmulatedScope
from .emulator import EmulatedBench, EmulatedSensor
from .link import Link, open_link
from .objective import HardwareObjective
from .scope import Microphone, Oscilloscope, ScopeSensor, open_scope
from .scpi import KEYSIGHT, RIGOL, Dialect, Waveform
from .sensor import FileSensor, ManualSensor, MovedMicrophone, Sensor, SensorError
from .usb import LinkError, Port

__all__ = [
    "KEYSIGHT",
    "OPENMPD",
    "RIGOL",
    "SONICSURFACE",
    "ULTRAINO",
    "Device",
    "Dialect",
    "EmulatedBench",
    "EmulatedScope",
    "EmulatedSensor",
    "FileSensor",
    "HardwareObjective",
    "Link",
    "LinkError",
    "ManualSensor",
    "Microphone",
    "MovedMicrophone",
    "Oscilloscope",
    "Port",
    "ScopeSensor",
    "Sensor",
    "SensorError",
    "Waveform",
    "open_link",
    "open_scope",
    "openmpd",
    "ultraino",
]
