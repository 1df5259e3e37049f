"""Goals of force: traps and lift of small spheres, and the push on a body.

All are Hermitian forms q^H A q of the drive q. Each is written as squares of magnitudes of rows R q with
weights of either sign, so that an objective can give the magnitudes as readings: methods take them as those
of control points, and bounds follow from the rows (`hermitian`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch

from autdtorch.analytic.momentum import PAIRS, force_forms
from autdtorch.analytic.spherical_waves import sphere_coefficients
from autdtorch.objectives.bound import checked_matrix
from autdtorch.objectives.goals import Goal
from autdtorch.objectives.hermitian import ascended, forms_bound
from autdtorch.objectives.objective import magnitudes, observe_drives
from autdtorch.propagators.derivatives import nodes_around, regular_coefficients
from autdtorch.propagators.propagator import Propagator
from autdtorch.propagators.tmatrix.force import force_matrices
from autdtorch.propagators.tmatrix.obstacle_groups import bodies_of
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.scene.geometry import sphere_points
from autdtorch.scene.particle import BEAD, Particle
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import Array
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.validation import (
    ArrayLike,
    Vector,
    integer_at_least,
    invalid,
    points_tensor,
    positive,
    real_tensor,
    require_kind,
    unit_vector,
)

_HALF = sphere_points((0.0, 0.0, 0.0), 1.0, 200)
DIRECTIONS: tuple[Vector, ...] = tuple((x, y, z) for x, y, z in _HALF.tolist() if z > 0)
"""DIRECTIONS: 100 of a half sphere; the least stiffness of all is lower by at most 5 % of its range."""

_LARGEST = 1.0  # k a of a small sphere, for which the degrees up to 3 scatter all but 1e-5
_SCATTERED = 3
_LEAST = 1e-12  # Eigenvalue of a form that is left out, relative to the largest
_TRANSPARENT = 1e-14  # Largest entry of T by rounding alone; 1e-10 at k a = 1e-3


@dataclass(frozen=True, eq=False)
class GoalOfForce(Goal):
    """Base of goals that score readings of a trap, lift or push, and have its name and unit.

    Attributes:
        of: the trap, lift or push.
    """

    of_pressures: ClassVar[bool] = False

    of: ForceGoal

    @property
    def name(self) -> str:  # type: ignore[override]
        """The name of the trap, lift or push."""
        return self.of.name

    @property
    def unit(self) -> str:  # type: ignore[override]
        """The unit of it."""
        return self.of.unit


@dataclass(frozen=True, eq=False)
class LeastForm(GoalOfForce):
    """The goal of a `ForceObjective`: the least of J forms, sums of N squared readings with weights.

    Attributes:
        of: the trap, lift or push.
        weights: (J, N).
    """

    weights: Array = field(repr=False)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, LeastForm):
            return NotImplemented
        return self.of == other.of and np.array_equal(self.weights, other.weights)

    def __hash__(self) -> int:
        return hash(self.of)

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the least form (...) of readings (..., N)."""
        readings = self.checked(pressure)
        return (readings.square() @ readings.new_tensor(self.weights).mT).amin(dim=-1)

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return the derivatives of the smooth least form."""
        weights = pressure.new_tensor(self.weights)
        forms = pressure.square() @ weights.mT
        temperature = smoothing * forms.abs().mean(dim=-1, keepdim=True)
        shares = torch.softmax(-forms / temperature.clamp_min(torch.finfo(forms.dtype).tiny), dim=-1)
        return 2 * pressure * (shares @ weights)

    def bound(self, G: ArrayLike) -> float:
        """Return the bound by the rows (N, M), 0 only if no drive scores above 0; see `Goal.bound`."""
        matrix = checked_matrix(G)
        self.check(len(matrix))
        return forms_bound(matrix, self.weights)

    def check(self, points: int) -> None:
        """Check the number of readings."""
        if points != self.weights.shape[1]:
            raise ValueError(
                f"pressure: {points} readings; must be {self.weights.shape[1]}, of a ForceObjective"
            )

    def wanted(self, points: int) -> Array:
        """Refuse: no pressures are wanted."""
        raise invalid("goal", self.name, "must want pressures, for this method; take gradient_ascent")

    def climbed(self, matrix: torch.Tensor, drive: torch.Tensor, iterations: int) -> torch.Tensor:
        """Return drives (S, M) at local maxima of the goal from drives (S, M), by the rows (N, M).

        Silence, which scores 0, replaces those that would score less.
        """
        drives = torch.from_numpy(ascended(matrix.numpy(), self.weights, drive.numpy(), iterations))
        return torch.where(self(magnitudes(matrix, drives))[:, None] > 0, drives, 0)


class ForceGoal(ABC):
    """Base of goals of a `ForceObjective`: `Trap`, `Levitate` and `Push`."""

    name: ClassVar[str]
    unit: ClassVar[str]

    @abstractmethod
    def forms(self, propagator: Propagator) -> tuple[torch.Tensor, Array]:
        """Return rows (N, M), complex128, and the weights (J, N) of their squares in the forms."""

    @abstractmethod
    def check(self, scene: Scene) -> None:
        """Check the goal against a scene before it is simulated; `ValueError` where it does not fit."""


@dataclass(frozen=True)
class _ParticleGoal(ForceGoal):
    """Base of goals of a small sphere at points, by the force and the stiffness there."""

    points: Sequence[Vector] | None
    directions: Sequence[Vector] | None = None
    particle: Particle = BEAD
    displacement: float = 2e-4

    def __post_init__(self) -> None:
        if self.points is not None:
            points = points_tensor("points", self.points)
            object.__setattr__(self, "points", tuple(tuple(point) for point in points.tolist()))
        if self.directions is not None:
            directions = real_tensor("directions", self.directions)
            if directions.ndim != 2 or directions.shape[1] != 3 or not len(directions):
                raise invalid("directions", self.directions, "must be (D, 3) with D >= 1")
            if not directions.norm(dim=1).min() > 0:
                raise invalid("directions", self.directions, "must not be 0")
            directions = directions / directions.norm(dim=1, keepdim=True)
            object.__setattr__(self, "directions", tuple(tuple(each) for each in directions.tolist()))
        require_kind("particle", self.particle, Particle)
        object.__setattr__(self, "displacement", positive("displacement", self.displacement, "m"))

    def check(self, scene: Scene) -> None:
        """Check that the sphere is small, and that bodies and the array are far enough from the points."""
        self._nodes(scene)
        _eigenrows(self.particle, scene)

    def _nodes(self, scene: Scene) -> torch.Tensor:
        """Return the nodes (P, S, 3) [m] around the points."""
        points = scene.control_points if self.points is None else points_tensor("points", self.points)
        return nodes_around(scene, points)

    def forms(self, propagator: Propagator) -> tuple[torch.Tensor, Array]:
        """Return rows (N, M) and the weights (J P, N) of their squares in the forms of each point."""
        scene = propagator.scene
        nodes = self._nodes(scene)
        matrix = propagator.transfer_matrix(nodes.reshape(-1, 3)).detach().cpu()
        pressure = matrix.reshape(*nodes.shape[:2], -1).mT
        waves = regular_coefficients(pressure, scene.complex_wavenumber, _SCATTERED + 2)
        factors, kinds, signs = _eigenrows(self.particle, scene)
        weights = np.stack([form[kinds] * signs for form in self._combined()])
        return (waves @ factors).mT.flatten(0, 1), np.kron(np.eye(len(nodes)), weights)

    @abstractmethod
    def _combined(self) -> Array:
        """Return the forms (J, 9) by force (3) and stiffness (6) at a point."""

    def _along(self) -> tuple[Array, Array]:
        """Return directions (D, 3), and the stiffness along each by its entries `PAIRS` (D, 6)."""
        directions = np.array(DIRECTIONS if self.directions is None else self.directions)
        entries = [(1 + (i != j)) * directions[:, i] * directions[:, j] for i, j in PAIRS]
        return directions, np.stack(entries, axis=1)


def _eigenrows(particle: Particle, scene: Scene) -> tuple[torch.Tensor, Array, Array]:
    """Return the map (N, R) from regular waves to rows, and the quantity (R,) and sign (R,) of each."""
    medium, k = scene.medium, scene.wavenumber
    if particle.radius * k > _LARGEST:
        accepted = f"must be at most {_LARGEST / k:.4g}: a larger one is a body of the scene"
        raise invalid("particle.radius", particle.radius, accepted, "m")
    density, speed = particle.density / medium.density, particle.sound_speed / medium.sound_speed
    ratios = sphere_coefficients(_SCATTERED, particle.radius * k, density, speed)
    scale = 1 / (2 * medium.density * scene.angular_frequency**2)
    maps, kinds, signs = [], [], []
    for kind, form in enumerate(force_forms(ratios, k, scale)):
        rows, sign = _squares(form)
        maps.append(rows.mT)
        kinds += [kind] * len(rows)
        signs.append(sign)
    return torch.cat(maps, dim=1), np.array(kinds), np.concatenate(signs)


def _squares(form: torch.Tensor) -> tuple[torch.Tensor, Array]:
    """Return rows (R, N) and signs (R,) of a Hermitian form: x^H A x is the sum of sign |row x|^2."""
    values, vectors = torch.linalg.eigh(form)
    some = values.abs() > _LEAST * values.abs().max()
    return (vectors[:, some] * values[some].abs().sqrt()).mH, values[some].sign().numpy()


@dataclass(frozen=True)
class Trap(_ParticleGoal):
    """The stiffness of traps of a small sphere: the least one, over points and directions [N/m].

    From each stiffness, the force along the direction over `displacement` is subtracted. A score above 0
    means that the sphere is pulled back along all directions, to a place within `displacement` of the point.
    Force and stiffness are exact for the sphere alone in the field: waves between it and other bodies are
    left out. `equilibrium` has them.

    Attributes:
        points: (P, 3) [m]; None for the control points of the scene.
        directions: (D, 3), along which it is held; None for 100, for all.
        particle: the sphere, of a radius up to 1 / k; a bead of EPS of 1 mm diameter by default.
        displacement: largest distance along a direction from the point to the place of equilibrium [m], > 0.
    """

    name: ClassVar[str] = "trap"
    unit: ClassVar[str] = "N/m"

    def _combined(self) -> Array:
        directions, stiffness = self._along()
        force = directions / self.displacement
        return np.concatenate([np.hstack([force, stiffness]), np.hstack([-force, stiffness])])


@dataclass(frozen=True)
class Levitate(_ParticleGoal):
    """The lift of a small sphere in traps, in weights of it: 1 holds it, more is the margin.

    The score is the least of two forces over the weight: the upward one, and over directions the restoring
    one at `reach`. From the latter, the sideways force times reach / displacement is subtracted. Take a score
    of s >= 1, an upward force of l >= s weights, and the drive times l^(-1/2). It holds the sphere within
    `displacement` of the point across gravity, and within l / s of `reach` along it if its weight doubles.
    Forces are those of `Trap`.

    Attributes:
        points: (P, 3) [m]; None for the control points of the scene.
        directions: (D, 3), along which it is held; None for 100, for all.
        particle: the sphere, of a radius up to 1 / k; a bead of EPS of 1 mm diameter by default.
        displacement: largest sideways distance from the point to the place of equilibrium [m], > 0.
        reach: distance over which the stiffness must make up the weight [m], > 0; by default 2 mm, a quarter
            of the wavelength at 40 kHz.
        up: direction against gravity (3,); any length.
    """

    name: ClassVar[str] = "levitate"
    unit: ClassVar[str] = ""

    reach: float = 2e-3
    up: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "reach", positive("reach", self.reach, "m"))
        object.__setattr__(self, "up", unit_vector("up", self.up))

    def _combined(self) -> Array:
        (directions, stiffness), up = self._along(), np.array(self.up)
        sideways = (directions - np.outer(directions @ up, up)) / self.displacement
        restoring = [np.hstack([sideways, stiffness]), np.hstack([-sideways, stiffness])]
        lift = np.hstack([up, np.zeros(len(PAIRS))])[None]
        return np.concatenate([lift, *(self.reach * part for part in restoring)]) / self.particle.weight


@dataclass(frozen=True)
class Push(ForceGoal):
    """The force along a direction on a body of a propagator of method "tmatrix" [N]; see `radiation_force`.

    Attributes:
        body: its index in `TMatrixPropagator.bodies.bodies`.
        direction: (3,); any length.
    """

    name: ClassVar[str] = "push"
    unit: ClassVar[str] = "N"

    body: int
    direction: Vector

    def __post_init__(self) -> None:
        object.__setattr__(self, "body", integer_at_least("body", self.body, 0))
        object.__setattr__(self, "direction", unit_vector("direction", self.direction))

    def check(self, scene: Scene) -> None:
        """Check that the scene has such a body."""
        if self.body >= (count := len(bodies_of(scene.obstacles))):
            accepted = f"must be in 0 to {count - 1}" if count else "must be a body, and the scene has none"
            raise invalid("body", self.body, accepted)

    def forms(self, propagator: Propagator) -> tuple[torch.Tensor, Array]:
        """Return rows (N, M), and the weights (1, N) of their squares in the force."""
        if not isinstance(propagator, TMatrixPropagator):
            raise invalid("propagator", propagator, 'must be of method "tmatrix", for the force on a body')
        matrices = force_matrices(propagator, self.body).detach()
        if not propagator.bodies.bodies[self.body].matrix.abs().max() > _TRANSPARENT:
            raise invalid(
                "body", self.body, "must scatter sound: a body that is as the medium feels no force"
            )
        form = torch.einsum("i,imn->mn", matrices.real.new_tensor(self.direction).to(matrices), matrices)
        rows, signs = _squares(form)
        return rows, signs[None]


class ForceObjective:
    """An objective of forces: its readings are magnitudes, from whose squares its goal gives the score.

    Methods maximise its goal by default.

    Attributes:
        scene: its array plays the drives; its control points do not count.
        goal: the score of readings, with a bound.
        evaluations: number of observations so far.
        transfer_matrix: the rows (N, M), complex128, of the readings; `goal.bound` takes them.
    """

    def __init__(self, propagator: Propagator, goal: ForceGoal) -> None:
        """Compute the rows of a trap, lift or push by a propagator."""
        require_kind("propagator", propagator, Propagator)
        if not isinstance(goal, ForceGoal):
            raise invalid("goal", goal, "must be a Trap, Levitate or Push")
        goal.check(propagator.scene)
        self.scene, self.evaluations = propagator.scene, 0
        rows, weights = goal.forms(propagator)
        self.transfer_matrix = rows.resolve_conj()
        if not self.transfer_matrix.any():
            raise invalid(
                "goal", goal, "must be of a force that some drive exerts: no sound is scattered there"
            )
        self.goal = LeastForm(goal, weights)

    @one_library_thread()
    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (..., M): readings (..., N), float64, on the CPU, without gradient."""
        return observe_drives(self._observe, drive, len(self.scene.array))

    def _observe(self, drive: torch.Tensor) -> torch.Tensor:
        self.evaluations += len(drive)
        return magnitudes(self.transfer_matrix, drive)
