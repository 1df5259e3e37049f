"""Several scenes as one objective, for drives that hold wherever an obstacle is."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import torch

from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal, goal_of, scores_pressures
from autdtorch.objectives.objective import (
    GoalFunction,
    Objective,
    SimulatedObjective,
    observe_drives,
    require_objective,
)
from autdtorch.objectives.over_scenes import By, OverScenes, checked_by
from autdtorch.objectives.perturbations import (
    FailedTransducers,
    Perturbation,
    continued,
    innermost,
    simulated_matrix,
)
from autdtorch.scene.obstacles.moving import angles_of
from autdtorch.utils.array_types import Array
from autdtorch.utils.text import counted
from autdtorch.utils.validation import (
    ArrayLike,
    integer_at_least,
    invalid,
    members,
    not_negative,
    real_tensor,
    require_kind,
    within,
)

if TYPE_CHECKING:
    from autdtorch.propagators import Propagator

_TURNS = "obstacles.turn_x", "obstacles.turn_y", "obstacles.turn_z"
_SHIFTS = "obstacles.x", "obstacles.y", "obstacles.z"


class Scenarios:
    """An objective over several scenes, scored by the worst, the mean or a quantile.

    Methods take it like any other objective. A drive observed in all scenes is one evaluation; the pressures
    are those of all S scenes, one scene after the other. Goals are scored in each scene and joined (see
    `OverScenes`). `LSSG` and pictures have the geometry of the first scene.

    Perturbations of the device, such as `Quantised`, go around the scenarios. `FailedTransducers` within them
    are supposed: the transfer matrix is without them.

    Attributes:
        objectives: of the scenes.
        by: "worst", "mean" or a quantile.
        scene: the first one.
        evaluations: number of observations so far.
        transfer_matrix: matrices of all scenes (S P, M) [Pa], one below the other; None where one has none.
    """

    def __init__(self, objectives: Iterable[Objective], by: By = "worst") -> None:
        """Check that the scenes fit each other.

        Args:
            objectives: of scenes with as many transducers and control points each; at least one.
            by: "worst", "mean", or a quantile in (0, 1): 0.1 is the score that nine of ten scenes exceed.

        Raises:
            ValueError: no objective, other numbers of transducers or points, other goals of force, or another
                `by`.
        """
        self.objectives: tuple[Objective, ...] = members("objectives", objectives, Objective)
        if not self.objectives:
            raise invalid("objectives", self.objectives, "must have at least one")
        for number, each in enumerate(self.objectives):
            with within(f"objectives[{number}]"):
                require_objective(each)
                if isinstance(each, Scenarios):
                    raise invalid("objective", each, "must be of one scene")
                counts, first = _counts(each), _counts(self.objectives[0])
                if counts != first:
                    accepted = f"must be {first}, as of the first"
                    raise invalid("numbers of transducers and control points", counts, accepted)
                if _goal_inside(each) != _goal_inside(self.objectives[0]):
                    raise invalid("goal of the objective", _goal_inside(each), "must be that of the first")
        self.by = checked_by(by)
        self.scene = self.objectives[0].scene
        self.evaluations = 0
        matrices = [matrix for each in self.objectives if (matrix := _matrix(each)) is not None]
        all_known = len(matrices) == len(self.objectives)
        self.transfer_matrix = torch.cat(matrices) if all_known else None

    @classmethod
    def around(
        cls,
        propagator: Propagator,
        count: int = 32,
        by: By = "worst",
        *,
        offset: ArrayLike = 0.0,
        rotation: ArrayLike = 0.0,
        warming: float = 0.0,
        gain: float = 0.0,
        phase: float = 0.0,
        failed: int = 0,
        seed: int = 0,
    ) -> Scenarios:
        """Return a scene and random variants of it, with the obstacles moved as one body.

        With T-matrices (``make_propagator(scene, "tmatrix")``) a pose takes milliseconds; other propagators
        simulate each.

        Args:
            propagator: of the scene, which is the first of the scenarios.
            count: number of scenes S, >= 1.
            by: see `Scenarios`.
            offset: shifts of the obstacles [m]: radius of a ball, or half edges (3,) of a box.
            rotation: turns of the obstacles [rad]: largest angle about any axis, or largest angles (3,) about
                x, y and z.
            warming: largest rise or fall of the air's temperature [K].
            gain: standard deviation of the logarithm of a transducer's gain.
            phase: of a transducer's phase [rad].
            failed: number of transducers that emit nothing, others in each scene.
            seed: of the random choices, >= 0. The first scenes do not depend on their number.

        Raises:
            ValueError: an argument out of range, or a change that the scene cannot make.
        """
        from autdtorch.propagators import Propagator
        from autdtorch.propagators.scene_changes import SceneChanges

        require_kind("propagator", propagator, Propagator)
        count, by, scene = integer_at_least("count", count, 1), checked_by(by), propagator.scene
        transducers, names, ranges = len(scene.array), list[str](), []
        for name, value, unit, changes in (
            ("offset", offset, "m", _SHIFTS),
            ("rotation", rotation, "rad", _TURNS),
            ("warming", warming, "K", ("temperature",)),
        ):
            if (sizes := _sizes(name, value, len(changes), unit)).any():
                names += changes
                ranges.append((name, sizes))
        deviations = np.array([[not_negative("gain", gain)], [not_negative("phase", phase, "rad")]])
        failed = integer_at_least("failed", failed, 0)
        if failed >= transducers:
            raise invalid("failed", failed, f"must be below the number of transducers, {transducers}")
        changes_of, seed = SceneChanges(propagator, names), integer_at_least("seed", seed, 0)
        objectives: list[Objective] = []
        for number in range(count):
            generator = np.random.default_rng([seed, number])
            drawn = [_drawn(generator, name, sizes) for name, sizes in ranges]
            amounts = np.concatenate([*drawn, np.zeros(0)]) * (number > 0)
            noise = generator.standard_normal((2, transducers)) * (number > 0)
            gains, phases = torch.from_numpy(noise * deviations).unbind()
            factors = torch.polar(gains.exp(), -phases)
            with within(f"scene {number} of the scenarios"):
                matrix = changes_of.matrix(amounts).cpu() * factors
                objective = SimulatedObjective.of_matrix(changes_of.scene(amounts), matrix)
            silent = generator.permutation(transducers)[:failed].tolist()
            objectives.append(FailedTransducers(objective, silent) if silent and number else objective)
        return cls(objectives, by)

    def __len__(self) -> int:
        return len(self.objectives)

    def __repr__(self) -> str:
        scenes, evaluations = counted(len(self), "scene"), counted(self.evaluations, "evaluation")
        return f"Scenarios({scenes}, by {self.by!r}, {evaluations})"

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (..., M) in every scene: pressure magnitudes (..., S P) [Pa]."""
        pressure = observe_drives(self._observe, drive, len(self.scene.array))
        self.evaluations += math.prod(pressure.shape[:-1])
        return pressure

    def scores(self, drive: torch.Tensor, goal: GoalFunction = WEAKEST_FOCUS) -> torch.Tensor:
        """Observe drives (..., M), and return the scores (..., S) of a goal in each scene."""
        over, _ = observed_goal(self, goal)
        assert isinstance(over, OverScenes)
        return over.by_scene(self(drive))

    def continued(self, number: int = 0) -> contextlib.AbstractContextManager[None]:
        """Take evaluations from `number` on out of the logs of measured scenes, as `HardwareObjective` does.

        `ValueError` if `number` is no integer >= 0; in the block `LogError` if a log has another drive.
        """
        return self._continued(integer_at_least("number", number, 0))

    @contextlib.contextmanager
    def _continued(self, number: int) -> Iterator[None]:
        with contextlib.ExitStack() as logs:
            for each in self.objectives:
                logs.enter_context(continued(each, number))
            yield

    def over(self, goal: GoalFunction = WEAKEST_FOCUS) -> OverScenes:
        """Return the goal over all scenes that methods maximise for a goal of each; one over all stays."""
        if isinstance(goal, OverScenes):
            if goal.scenes != len(self):
                raise invalid("goal.scenes", goal.scenes, f"must be {len(self)}, as of the scenarios")
            return goal
        return OverScenes(goal_of(goal), len(self), self.by)

    def _observe(self, drive: torch.Tensor) -> torch.Tensor:
        return torch.cat([each(drive) for each in self.objectives], dim=-1)


def observed_goal(objective: Objective, goal: GoalFunction) -> tuple[GoalFunction, int]:
    """Return the goal for the pressures that an objective observes, and their number.

    Where `goal` is the paper's, an objective may have another, and another number of readings.
    """
    inside, matrix = innermost(objective), simulated_matrix(objective)
    if isinstance(inside, Scenarios):
        each, points = observed_goal(inside.objectives[0], goal)
        return inside.over(each), len(inside) * points
    of_readings = _goal_inside(objective)
    if goal is WEAKEST_FOCUS:
        goal = of_readings
    elif isinstance(goal, Goal) and goal.of_pressures and not scores_pressures(of_readings):
        accepted = "must not be of pressures, which this objective does not read; leave it out"
        raise invalid("goal", goal.name, accepted)
    points = len(objective.scene.control_points if matrix is None else matrix)
    return goal, getattr(inside, "readings", points)


def _goal_inside(objective: Objective) -> GoalFunction:
    """Return the goal that an objective has, or else the paper's."""
    goal: GoalFunction = getattr(innermost(objective), "goal", WEAKEST_FOCUS)
    return goal


def _counts(objective: Objective) -> tuple[int, int]:
    return len(objective.scene.array), observed_goal(objective, WEAKEST_FOCUS)[1]


def _matrix(objective: Objective) -> torch.Tensor | None:
    """Return the transfer matrix (P, M) [Pa] of a scene, 0 for transducers that failed."""
    matrix = simulated_matrix(objective)
    while matrix is not None and isinstance(objective, Perturbation):
        if isinstance(objective, FailedTransducers):
            matrix = objective.emitted(torch.ones_like(matrix[0])) * matrix
        objective = objective.inner
    return matrix


def _sizes(name: str, value: ArrayLike, count: int, unit: str) -> Array:
    """Return the radius (1,) of a ball, or the half edges (count,) of a box."""
    sizes = np.atleast_1d(real_tensor(name, value, unit).detach().cpu().numpy())
    if sizes.shape not in ((1,), (count,)) or sizes.min() < 0:
        accepted = "must be a number >= 0" + (f", or {count} of them" if count > 1 else "")
        raise invalid(name, value, accepted, unit)
    return sizes


def _drawn(generator: np.random.Generator, name: str, sizes: Array) -> Array:
    """Return amounts of a change from a box, or from a ball of its radius."""
    if name == "warming" or len(sizes) > 1:
        return sizes * generator.uniform(-1, 1, len(sizes))
    direction = generator.standard_normal(3)
    vector: Array = sizes * generator.random() ** (1 / 3) * direction / np.linalg.norm(direction)
    if name == "offset":
        return vector
    from scipy.spatial.transform import Rotation

    turn = torch.from_numpy(Rotation.from_rotvec(vector).as_matrix())
    return np.array(angles_of(turn).tolist())
