from .devices import AUTD3, DEVICES, OPENMPD, SONICSURFACE, ULTRAINO
from .devices.device import Device
from .devices.openmpd import openmpd_boards
from .devices.ultraino import ultraino_boards
from .emulator.bench import EmulatedBench, EmulatedSensor
from .emulator.emulated_scope import EmulatedScope
from .link import Link, OffError, open_autd3, open_link
from .log import Evaluation, EvaluationLog, LogError, lock_log
from .objective import HardwareObjective
from .played import Played
from .preflight import Preflight, check_transducers, hears_silence
from .safety import LimitedLink, LimitError, Limits, Signalled, ended_by_signals
from .sensors.by_hand import ManualSensor, MovedMicrophone
from .sensors.oscilloscope import Microphone, Oscilloscope, ScopeSensor, open_scope
from .sensors.reading_file import FileSensor
from .sensors.scpi import KEYSIGHT, RIGOL, Dialect, Waveform
from .sensors.sensor import Sensor, SensorError
from .transport.port import LinkError, Port
from .transport.serial_chips import Adapter
from .transport.usbtmc import UsbtmcPort

__all__ = [
    "AUTD3",
    "DEVICES",
    "KEYSIGHT",
    "OPENMPD",
    "RIGOL",
    "SONICSURFACE",
    "ULTRAINO",
    "Adapter",
    "Device",
    "Dialect",
    "EmulatedBench",
    "EmulatedScope",
    "EmulatedSensor",
    "Evaluation",
    "EvaluationLog",
    "FileSensor",
    "HardwareObjective",
    "LimitError",
    "LimitedLink",
    "Limits",
    "Link",
    "LinkError",
    "LogError",
    "ManualSensor",
    "Microphone",
    "MovedMicrophone",
    "OffError",
    "Oscilloscope",
    "Played",
    "Port",
    "Preflight",
    "ScopeSensor",
    "Sensor",
    "SensorError",
    "Signalled",
    "UsbtmcPort",
    "Waveform",
    "check_transducers",
    "ended_by_signals",
    "hears_silence",
    "lock_log",
    "open_autd3",
    "open_link",
    "open_scope",
    "openmpd_boards",
    "ultraino_boards",
]
