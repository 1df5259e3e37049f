"""The devices that a link can drive, a module each.

A device is its class of frames and emulated firmware, and a line in `DEVICES`: `save_drive`, links, emulated
benches and the trial script find everything else there.
"""

from __future__ import annotations

from autdtorch.hardware.devices.autd3 import AUTD3
from autdtorch.hardware.devices.device import Device
from autdtorch.hardware.devices.openmpd import OPENMPD
from autdtorch.hardware.devices.sonicsurface import SONICSURFACE
from autdtorch.hardware.devices.ultraino import ULTRAINO
from autdtorch.utils.hints import nearest_name
from autdtorch.utils.validation import invalid

#: Every device by its name in files and options.
DEVICES: dict[str, Device] = {
    "autd3": AUTD3,
    "openmpd": OPENMPD,
    "sonicsurface": SONICSURFACE,
    "ultraino": ULTRAINO,
}


def require_device(device: object) -> None:
    """Refuse what is no device, such as the name of one."""
    if isinstance(device, Device):
        return
    name = nearest_name(device, DEVICES) or "sonicsurface"
    network = " on USB; open_autd3() opens AUTD3 on the network" if name == "autd3" else ""
    raise invalid("device", device, f"must be a Device, such as hardware.{name.upper()}{network}")
