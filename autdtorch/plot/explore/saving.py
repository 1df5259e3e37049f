"""The scene and the drive of a live view as files and as lines of Python."""

from __future__ import annotations

import itertools
from pathlib import Path

from autdtorch.hardware.devices import DEVICES
from autdtorch.io.drive_file import save_drive
from autdtorch.io.scene_writer import save_scene, scene_lines
from autdtorch.plot.explore.situation import Situation
from autdtorch.utils.files import replace_file

SCENE = "scene"
"""Name of the scene file and, with a number, of meshes beside it."""

_FOLDER = Path("outputs/explore")


def free_folder() -> str:
    """Return the name of a folder that does not exist yet."""
    names = (f"{_FOLDER}_{number}" if number > 1 else str(_FOLDER) for number in itertools.count(1))
    return next(name for name in names if not Path(name).exists())


def python_of(situation: Situation, folder: str) -> str:
    """Return the lines of Python that make scene and drive; meshes are read from files saved in a folder.

    Raises:
        ValueError: an obstacle of a user's class.
    """
    return scene_lines(situation.scene, situation.drive, str(Path(folder) / SCENE))


def devices_of(situation: Situation) -> list[str]:
    """Return the names of the devices whose boards have the number of transducers."""
    count = len(situation.drive)
    return [name for name, device in DEVICES.items() if count % device.board == 0]


def save(situation: Situation, folder: str, device: str, replaces: bool) -> Path:
    """Write scene.yaml, drive.npz, scene.py and, for a device, its levels; return the folder.

    Args:
        situation: scene and drive.
        folder: to write into, below the working directory; it is made.
        device: a name in `devices_of`, or "".
        replaces: whether files in the folder are replaced.

    Raises:
        ValueError: a folder elsewhere, one that is not empty and not to be replaced, or another device.
        OSError: the files cannot be written.
    """
    path, here = Path(folder), Path.cwd().resolve()
    if not folder.strip() or path.is_absolute() or not (here / path).resolve().is_relative_to(here):
        raise ValueError(f"folder: {folder!r}; must be below the working directory")
    if device and device not in devices_of(situation):
        raise ValueError(f"device: {device!r}; must be one of {devices_of(situation)}")
    if not replaces and path.exists() and any(path.iterdir()):
        raise ValueError(f"folder: {folder!r} has other files; must be new or empty")
    path.mkdir(parents=True, exist_ok=True)
    save_scene(path / f"{SCENE}.yaml", situation.scene)
    save_drive(path / "drive.npz", situation.drive, situation.scene.array)
    if device:
        save_drive(path / f"drive_{device}.csv", situation.drive, situation.scene.array, device)
    lines = scene_lines(situation.scene, situation.drive, SCENE, beside=True)
    replace_file(path / f"{SCENE}.py", lines.encode())
    return path
