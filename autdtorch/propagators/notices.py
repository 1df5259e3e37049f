"""Notices on scenes and results: inaccurate places, silence, resonances, runs without a steady state."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch

from autdtorch.fdtd.assembly.unions import warn_of_narrow_gaps, warn_of_thin_walls
from autdtorch.fdtd.grid_axes import axes_along
from autdtorch.fdtd.region import warn_if_coarse
from autdtorch.propagators.plan import Plan, walls_of
from autdtorch.propagators.simulation import Run, Simulation
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import Array
from autdtorch.utils.text import counted
from autdtorch.utils.units import warn_user

logger = logging.getLogger(__name__)

_RINGING = 100
"""Periods from which a run indicates a resonance. Runs of bodies without any take 15 to 60; a quality factor
is about half the periods, and a grid of 1.3 mm shifts frequencies by 0.2 %."""

_SHARP = 2.0
"""Ratio of densities from which a fluid in a rigid body resonates so much more sharply than air that claims
of error were down to 0.3 of it."""

_ALMOST_RIGID = 150.0
"""Ratio of densities from which cells that a fluid cuts err by more than those that a rigid body cuts."""

_FAINT = 1e-7
"""Pressure relative to that in free space, -140 dB, which is rounding in single precision."""


class SteadyStateWarning(UserWarning):
    """A simulation ended before its steady state was reached."""


class Notices:
    """Log entries on the results of a simulation, each kind once."""

    def __init__(self, simulation: Simulation, logged: set[str]) -> None:
        """Log nothing yet, and later no kind that is `logged` on another grid; those of here are added."""
        self._simulation, self._plan, self._logged = simulation, simulation.plan, logged

    def of_points(self, points: torch.Tensor) -> None:
        """Log which points (P, 3) are next to a surface."""
        if "surface" not in self._logged:
            near = warn_of_near_points(self._plan.scene, "points", points, self._plan.spacing)
            self._logged |= {"surface"} if near else set()

    def of_cavities(self, points: torch.Tensor, pressure: torch.Tensor) -> None:
        """Log that points (P, 3), with the pressure (P, K) of drives, are closed off by rigid obstacles."""
        silent = points[(pressure == 0).all(dim=1)]
        if len(silent) and "cavity" not in self._logged:
            enclosed = silent[self._simulation.enclosed(silent)]
            if len(enclosed):
                more = f" and {len(enclosed) - 1} more" if len(enclosed) > 1 else ""
                text = "rigid obstacles close off the point at %s mm%s: pressure 0 (%s)"
                gaps = f"gaps narrower than a cell, {1e3 * self._plan.spacing:.2g} mm, may count as closed"
                self._once("cavity", text, _in_mm(enclosed[0]), more, gaps)

    def of_unknown_gaps(self, spacing: float, reason: str) -> None:
        """Log that cells of a spacing [m], which may open gaps to silent points, are refused for a reason."""
        text = "the error takes silent points as closed off; cells of %.2g mm, which may open gaps,"
        self._once("gaps", f"{text} are refused: %s", 1e3 * spacing, reason)

    def of_faint_points(self, matrix: torch.Tensor, free: torch.Tensor) -> None:
        """Log that the matrix at control points is rounding, relative to free space: methods would use it."""
        size = matrix.norm(dim=1)
        faint = self._plan.scene.control_points[(size > 0) & (size < _FAINT * free.norm(dim=1))]
        if len(faint):
            more = f", nor {len(faint) - 1} more" if len(faint) > 1 else ""
            text = "no sound reaches the point at %s mm%s: its pressure is rounding"
            self._once("faint", text, _in_mm(faint[0]), more)

    def of_ringing(self, periods: int) -> None:
        """Log that obstacles resonate, where grids may agree and be wrong together."""
        if periods > _RINGING:
            text = "sound rings for %d periods in or between obstacles: next to a resonance %s"
            shift = (
                "a small shift of its frequency changes the field, and the error may be larger than estimated"
            )
            self._once("ringing", text, periods, shift)

    def _once(self, kind: str, text: str, *values: object) -> None:
        if kind not in self._logged:
            self._logged.add(kind)
            logger.warning(text, *values)


def warn_of_scene(plan: Plan) -> None:
    """Log the parts of a scene that are less accurate on the grids of a plan, and walls that end."""
    scene, region, spacing = plan.scene, plan.region, plan.spacing
    warn_if_coarse(region.sound_speeds, scene.frequency, spacing)
    warn_of_ending_walls(scene)
    if hard := [body for body in region.bodies if body.rigid_error]:
        logger.info(
            "obstacle %s is simulated as rigid: the material changes the field by about %.2g %%, less than"
            " the error to expect", ", ".join(str(body.number) for body in hard),
            100 * max(body.rigid_error for body in hard),
        )  # fmt: skip
    grids: list[tuple[Sequence[int], Array]] = [(grid.group, grid.axes) for grid in plan.grouping.grids]
    if plan.method == "tmatrix":  # each body has a grid along its faces
        grids = [([body.number], axes_along([body.faces])) for body in region.bodies]
    else:
        warn_of_narrow_gaps(region, spacing, grids)
    warn_of_thin_walls(region, spacing, grids)
    if region.held_contrast > _SHARP:
        logger.warning(
            "a fluid in a rigid obstacle is %.2g times as dense as the air, or as light: it resonates"
            " sharply, and the error may be larger than estimated", region.held_contrast,
        )  # fmt: skip
    if not plan.grouping.aligned and region.largest_density > _ALMOST_RIGID:
        logger.warning(
            "a round or tilted obstacle is %.3g times as dense as the air: its error is estimated less well,"
            " true ones were mostly 0.5 to 2 times the estimate, at most 5 times; rigid=True is more accurate"
            " if what passes it may be neglected",
            region.largest_density,
        )  # fmt: skip
    warn_of_near_points(scene, "array.positions", scene.array.positions, spacing)
    warn_of_near_points(scene, "control_points", scene.control_points, spacing)


def warn_of_ending_walls(scene: Scene) -> None:
    """Log which walls end before the absorbing layers because an earlier wall has another direction."""
    walls = enumerate(walls_of(scene))
    if ending := [str(index) for index, (wall, continued) in walls if wall and not continued]:
        logger.warning(
            "obstacle %s crosses the domain in another direction than a wall before: it ends where the"
            " absorbing layer begins, and its end reflects", ", ".join(ending),
        )  # fmt: skip


def warn_of_near_points(scene: Scene, name: str, points: torch.Tensor, spacing: float) -> bool:
    """Log which points (P, 3) [m] are less than a cell from a surface, on either side; return whether any."""
    is_near = False
    for index, obstacle in enumerate(scene.obstacles):
        around = obstacle.near(points, spacing).nonzero()[:, 0]
        gap = obstacle.signed_distance(points[around]) if len(around) else points.new_zeros(0)
        if count := int((gap.abs() < spacing).sum()):
            is_near, nearest = True, int(gap.abs().argmin())
            point = int(around[nearest])
            logger.warning(
                "%s[%d] at %s mm is %.2g mm %s obstacle %d%s: less accurate within a cell, %.2g mm, of a"
                " surface", name, point, _in_mm(points[point]),
                1e3 * abs(float(gap[nearest])), "inside" if gap[nearest] < 0 else "from", index,
                f", and {count - 1} more are near it" if count > 1 else "", 1e3 * spacing,
            )  # fmt: skip
    return is_near


def warn_of_unsettled(runs: Sequence[Run], tolerance: float) -> None:
    """Warn of runs that did not converge."""
    if unsettled := [run for run in runs if not run.reached]:
        what = f"after {max(run.periods for run in unsettled)} periods in {len(unsettled)} of"
        residual = max(run.remaining for run in unsettled)
        warn_of_no_steady_state(f"{what} {counted(len(runs), 'run')}", residual, tolerance)


def warn_of_no_steady_state(
    what: str, residual: float, tolerance: float, advice: str = "max_periods or tolerance"
) -> None:
    """Warn that runs ended before their steady state; `what` tells when, and the advice what to raise."""
    error = f"estimated relative error up to {residual:.1e}, tolerance {tolerance:g}"
    warn_user(f"no steady state {what}: {error}; raise {advice}", SteadyStateWarning)


def _in_mm(point: torch.Tensor) -> tuple[float, ...]:
    return tuple(round(1e3 * entry, 3) for entry in point.tolist())
