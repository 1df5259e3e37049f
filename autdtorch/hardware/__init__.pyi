from .adapters import Adapter
from .autd3 import open_autd3
from .devices import OPENMPD, SONICSURFACE, ULTRAINO, Device, openmpd_boards, ultraino_boards
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
    "Adapter",
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
    "open_autd3",
    "open_link",
    "openmpd_boards",
    "ultraino_boards",
]
