"""Calibration: the scene of a config is fitted to readings in a file, and the result is left in a folder."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig

from autdtorch.cli.settings import (
    folder_of,
    given_readings,
    is_given,
    require_effective,
    scene_of,
    section_of,
    solver_of,
)
from autdtorch.io.calibration_file import save_calibration
from autdtorch.io.scene_file import save_scene, scene_sections
from autdtorch.methods.calibration.calibrate import calibrate
from autdtorch.methods.prior import Prior, prior_of
from autdtorch.plot.calibration_figure import plot_calibration
from autdtorch.propagators import make_propagator
from autdtorch.utils.files import replace_file
from autdtorch.utils.validation import invalid, require_known, within

_EFFECTIVE = re.compile(r"\+*(scene|modules|solver|calibrate|readings|seed|output|hydra)\b")
_KEYS = ("file", "prior", "folds")
_OF_FILE = ("columns", "phases", "pressure", "phase")  # arguments of `load_readings`


def calibrate_scene(settings: dict[str, Any], modules: list[Any], output: Any) -> None:
    """Calibrate the scene of the settings, write the results to a folder, and print the summary.

    Raises:
        ValueError: a setting that is unknown, out of range or without effect here, or readings that do not
            fit.
    """
    require_effective("calibrate", _EFFECTIVE, "scene, readings, calibrate.KEY, solver.KEY or output")
    section = section_of(settings, "calibrate")
    require_known("calibrate", section, _KEYS)
    prior = prior_of("calibrate.prior", section["prior"]) or Prior()
    scene = scene_of("scene", section_of(settings, "scene"), modules)
    name = f"{HydraConfig.get().runtime.choices['scene']}_calibrated"
    scene_sections(scene, name)  # refuses a scene that cannot be saved
    of_file = section["file"] or {}
    require_known("calibrate.file", of_file, _OF_FILE)
    readings = given_readings(settings.get("readings"), **of_file)
    if readings is None:
        raise invalid("readings", None, "must be a file, as in readings=trial.csv")
    folder = folder_of("output", output) if is_given("output") else Path("outputs") / name
    propagator = make_propagator(scene, **solver_of(settings))
    with within("calibrate"):
        calibration = calibrate(
            propagator, readings, prior, folds=section["folds"], seed=settings.get("seed", 0)
        )
    folder.mkdir(parents=True, exist_ok=True)
    save_calibration(folder / "calibration.npz", calibration)
    plot_calibration(calibration).savefig(folder / "calibration.png")
    calibrated = calibration.scene
    assert calibrated is not None
    (folder / "scene").mkdir(exist_ok=True)  # so that the folder is one for --config-dir
    save_scene(folder / "scene" / f"{name}.yaml", calibrated)
    replace_file(folder / "summary.txt", f"{calibration.summary()}\n".encode())
    shown = shlex.quote(os.path.relpath(folder))
    print(f"{calibration.summary()}\nThe calibration is in {shown}; its scene serves as", flush=True)
    print(f"  autdtorch --config-dir {shown} scene={name}")
