from .devices import OPENMPD, SONICSURFACE, ULTRAINO, Device, openmpd, ultraino
from .emulator import EmulatedBench, EmulatedSensor
from .link import Link, open_link
from .log import Evaluation, EvaluationLog
from .objective import HardwareObjective
from .preflight import Preflight, check_transducers, hears_silence
from .safety import LimitedLink, LimitError, Limits, Signalled, ended_by_signals
from .sensor import Sensor
from .usb import LinkError, Port

__all__ = [
    "OPENMPD",
    "SONICSURFACE",
    "ULTRAINO",
    "Device",
    "EmulatedBench",
    "EmulatedSensor",
    "Evaluation",
    "EvaluationLog",
    "HardwareObjective",
    "LimitError",
    "LimitedLink",
    "Limits",
    "Link",
    "LinkError",
    "Port",
    "Preflight",
    "Sensor",
    "Signalled",
    "check_transducers",
    "ended_by_signals",
    "hears_silence",
    "open_link",
    "openmpd",
    "ultraino",
]
