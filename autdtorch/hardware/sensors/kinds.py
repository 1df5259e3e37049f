"""The kinds of sensor that a config may name.

A sensor is a class and the class of its config, in a module, and a line in `SENSORS`.
"""

from autdtorch.hardware.camera.camera_config import CameraConfig
from autdtorch.hardware.sensors.by_hand import ManualConfig
from autdtorch.hardware.sensors.file_sensor import FileConfig
from autdtorch.hardware.sensors.scope_microphones import ScopeConfig
from autdtorch.hardware.sensors.sensor import EmulatedConfig, SensorConfig

__all__ = ["SENSORS"]

#: The config of every kind of sensor, by the kind.
SENSORS: dict[str, type[SensorConfig]] = {
    "emulated": EmulatedConfig,
    "scope": ScopeConfig,
    "file": FileConfig,
    "manual": ManualConfig,
    "camera": CameraConfig,
}
