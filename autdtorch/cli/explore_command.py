"""The live view of a scene in a browser: `autdtorch explore scene=two_cubes`."""

from __future__ import annotations

import re
import signal
from typing import Any

from hydra.core.hydra_config import HydraConfig

from autdtorch.cli.settings import is_given, scene_of, section_of, solver_of
from autdtorch.io.drive_file import load_drive
from autdtorch.plot.explore import explore
from autdtorch.utils.process import signals_restored
from autdtorch.utils.validation import invalid, path_of, require_known, within

_KEYS = ("port", "browser", "drive")
_USED = re.compile(r"\+*(scene|modules|explore|hydra)\b|\+*solver\.spacing=")


def explore_scene(settings: dict[str, Any], modules: list[Any]) -> None:
    """Show the scene of the settings until Ctrl+C or SIGTERM, which a job in the background gets, ends it.

    Raises:
        ValueError: a setting of `explore` that is unknown or out of range, or one that has no effect here.
    """
    for override in HydraConfig.get().overrides.task:
        if not _USED.match(override):
            accepted = "has no effect on explore; give scene, modules, solver.spacing or explore.KEY"
            raise ValueError(f"{override}: {accepted}")
    section = section_of(settings, "explore")
    require_known("explore", section, _KEYS)
    drive = None
    if (file := section.get("drive")) is not None:
        if not is_given("explore.drive"):
            raise invalid("explore.drive", file, "must be given on the command line")
        with within("explore.drive"):
            drive = load_drive(path_of("drive", file))
    scene = scene_of("scene", section_of(settings, "scene"), modules)
    spacing, port, browser = solver_of(settings)["spacing"], section["port"], section["browser"]
    with signals_restored():
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        explorer = explore(scene, drive, spacing=spacing, port=port, open_browser=browser)
        try:
            print(f"The live view is at {explorer.address}\nCtrl+C ends it.", flush=True)
            explorer.wait()
        except KeyboardInterrupt:
            explorer.close()
