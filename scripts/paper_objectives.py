"""The paper's three scenes as objectives, for the studies of methods."""

from __future__ import annotations

from pathlib import Path

import autdtorch as at

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SCENES = ("homogeneous", "three_cubes", "two_cubes")


def paper_objectives() -> dict[str, at.SimulatedObjective]:
    """Undisturbed objectives by scene, simulated at the default spacing."""
    scenes = {name: at.load_scene(ROOT / "configs" / "scene" / f"{name}.yaml") for name in SCENES}
    return {name: at.SimulatedObjective(scene, at.make_propagator(scene)) for name, scene in scenes.items()}
