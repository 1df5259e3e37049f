"""The method by which a scene is simulated."""

from __future__ import annotations

import logging

from autdtorch.fdtd.grid import Extent, bodies_extent, domain_extent, require_spacing
from autdtorch.propagators.cost import full_cost, grid_cost, most_runs
from autdtorch.propagators.groups import cheapest_grouping
from autdtorch.propagators.scene_region import is_wall, region_of
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import invalid, require_one_of

logger = logging.getLogger(__name__)


METHODS = ("auto", "free_space", "box", "full")


def method_for(scene: Scene, method: str, spacing: float, tolerance: float) -> str:
    """Return the method that was asked for, "auto" being the cheapest that is right for the scene.

    Raises:
        ValueError: no such method, a box around nothing, or cells too large or too small for what is chosen.
    """
    require_one_of("method", method, METHODS)
    if method == "box" and not scene.obstacles:
        raise invalid("method", method, "needs a scene with obstacles; take free_space")
    return _chosen_method(scene, spacing, tolerance) if method == "auto" else method


def _chosen_method(scene: Scene, spacing: float, tolerance: float) -> str:
    """The cheapest method that is right for a scene, and why, in the log.

    Args:
        scene: what is simulated.
        spacing: edge of a cell [m].
        tolerance: relative error to which boxes are coupled, if several are cheaper than one.
    """
    if not scene.obstacles:
        logger.info("method auto: free_space (no obstacles: nothing to simulate)")
        return "free_space"
    require_spacing(region_of(scene), spacing)
    runs = most_runs(scene)
    domain = grid_cost(scene, domain_extent(region_of(scene), spacing), spacing)
    boxes = cheapest_grouping(scene, spacing, tolerance, runs)
    gain = full_cost(domain, runs) / boxes.cost(runs)
    if any(is_wall(scene, obstacle) for obstacle in scene.obstacles):
        method, reason = "full", "a wall goes on without end"
    elif any(_reaches_out(scene, bodies_extent([obstacle])) for obstacle in scene.obstacles):
        method, reason = "box", "obstacles reach out of the domain, where full would cut them off"
    elif gain > 1:
        method, reason = "box", f"{gain:.2g} times cheaper than full"
    else:
        method, reason = "full", f"{1 / gain:.2g} times cheaper than box"
    grids, passes = (boxes.grids, boxes.passes) if method == "box" else ((domain,), 1)
    cells, steps = sum(grid.cells for grid in grids), max(grid.steps for grid in grids) * passes
    logger.info(
        "method auto: %s (%s), about %s but for mirror images", method, reason, _shown(cells, steps, runs)
    )
    skipped = {
        "cells": 1 - cells / domain.cells,
        "steps": 1 - steps / domain.steps,
        "runs": 1 - runs / len(scene.array),
    }
    logger.info(
        "skipped of the naive plan, the domain and a run a transducer (%s): %s",
        _shown(domain.cells, domain.steps, len(scene.array)),
        ", ".join(f"{100 * share:.0f} % of the {what}" for what, share in skipped.items()),
    )
    return method


def _shown(cells: int, steps: int, runs: int) -> str:
    return f"{cells:,} cells x {steps:,} steps x {runs:,} runs"


def _reaches_out(scene: Scene, extent: Extent) -> bool:
    lower, upper = scene.domain
    pairs = zip(lower, extent.lower, strict=True), zip(extent.upper, upper, strict=True)
    return any(inner > outer for pair in pairs for inner, outer in pair)
