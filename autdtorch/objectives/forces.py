"""Goals of force: traps of small particles, lift against gravity, and the push on a body.

All are Hermitian forms q^H A q of the drive q. Each is written as squares of magnitudes of rows R q with
weights of either sign, so that an objective can give the magnitudes as readings: methods take them as those
of control points, and bounds follow from the rows (`hermitian`).
"""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from autdtorch.objectives.bound import checked_matrix
from autdtorch.objectives.goals import Goal
from autdtorch.objectives.hermitian import ascended, forms_bound
from autdtorch.objectives.objective import magnitudes, observe_drives
from autdtorch.propagators.derivatives import Derivatives, derivatives, nodes_around
from autdtorch.propagators.gorkov import factors, warn_of_large
from autdtorch.propagators.propagator import Propagator
from autdtorch.scene.particle import Particle
from autdtorch.utils.array_types import Array
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.validation import (
    ArrayLike,
    Vector,
    invalid,
    points_tensor,
    positive,
    real_tensor,
    require_kind,
    unit_vector,
)

_AXES = [axis for axis in itertools.product((-1, 0, 1), repeat=3) if axis > (0, 0, 0)]
DIRECTIONS: tuple[Vector, ...] = tuple(unit_vector("direction", axis) for axis in _AXES)
"""DIRECTIONS: 13, along edges, and diagonals of faces and bodies, of a cube."""

_PAIRS = (0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)
_PRODUCTS = (4,) * 3 + (8,) * 6  # of force along x, y and z, and of the stiffness of each pair
_READINGS = 2 * sum(_PRODUCTS)
_TINY = 1e-300


@dataclass(frozen=True)
class ForceGoal(Goal):
    """Base of goals of force: the least of some Hermitian forms, sums of squared readings with weights."""

    @abstractmethod
    def rows(self, propagator: Propagator) -> torch.Tensor:
        """Return the rows (N, M), complex128, whose magnitudes are the readings."""

    @abstractmethod
    def weights(self, readings: int) -> Array:
        """Return the weights (J, N) of the squares of N readings in each form."""

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the least form (...) of readings (..., N)."""
        return self._forms(self.checked(pressure)).amin(dim=-1)

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return the derivatives of the smooth least form."""
        weights = pressure.new_tensor(self.weights(pressure.shape[-1]))
        forms = pressure.square() @ weights.mT
        temperature = smoothing * forms.abs().mean(dim=-1, keepdim=True)
        shares = torch.softmax(-forms / temperature.clamp_min(torch.finfo(forms.dtype).tiny), dim=-1)
        return 2 * pressure * (shares @ weights)

    def bound(self, G: ArrayLike) -> float:
        """Return the bound by the rows (N, M), 0 only if no drive scores above 0; see `Goal.bound`."""
        matrix = checked_matrix(G)
        self.check(len(matrix))
        return forms_bound(matrix, self.weights(len(matrix)))

    def climbed(self, matrix: torch.Tensor, drive: torch.Tensor, iterations: int) -> torch.Tensor:
        """Return drives (S, M) at local maxima of the goal from drives (S, M), by the rows (N, M)."""
        rows, weights = matrix.numpy(), self.weights(len(matrix))
        return torch.stack(
            [torch.from_numpy(ascended(rows, weights, each, iterations)) for each in drive.numpy()]
        )

    def wanted(self, points: int) -> Array:
        """Refuse: no pressures are wanted."""
        raise invalid("goal", self, "must want pressures, for this method; take gradient_ascent")

    def _forms(self, readings: torch.Tensor) -> torch.Tensor:
        return readings.square() @ readings.new_tensor(self.weights(readings.shape[-1])).mT


@dataclass(frozen=True)
class _ParticleGoal(ForceGoal):
    """Base of goals of a small particle at points, by the force and the stiffness there."""

    points: Sequence[Vector]
    particle: Particle
    directions: Sequence[Vector] = DIRECTIONS
    displacement: float = 2e-4

    def __post_init__(self) -> None:
        """Check the fields."""
        points = points_tensor("points", self.points)
        object.__setattr__(self, "points", tuple(tuple(point) for point in points.tolist()))
        require_kind("particle", self.particle, Particle)
        directions = real_tensor("directions", self.directions)
        if directions.ndim != 2 or directions.shape[1] != 3 or not len(directions):
            raise invalid("directions", self.directions, "must be (D, 3) with D >= 1")
        if not directions.norm(dim=1).min() > 0:
            raise invalid("directions", self.directions, "must not be 0")
        directions = directions / directions.norm(dim=1, keepdim=True)
        object.__setattr__(self, "directions", tuple(tuple(direction) for direction in directions.tolist()))
        object.__setattr__(self, "displacement", positive("displacement", self.displacement, "m"))

    def rows(self, propagator: Propagator) -> torch.Tensor:
        """Return the rows (120 P, M) of force [N^(1/2)] and stiffness [(N/m)^(1/2)]."""
        require_kind("propagator", propagator, Propagator)
        scene = propagator.scene
        warn_of_large(self.particle, scene)
        nodes = nodes_around(scene, points_tensor("points", self.points))
        matrix = propagator.transfer_matrix(nodes.reshape(-1, 3)).detach().cpu()
        field = derivatives(matrix.reshape(*nodes.shape[:2], -1).mT, scene.complex_wavenumber)
        return _particle_rows(field, *factors(self.particle, scene)).reshape(-1, matrix.shape[1])

    def weights(self, readings: int) -> Array:
        """Return the weights (J P, 120 P) of the forms of each point."""
        signs = np.concatenate([np.repeat((1.0, -1.0), count) for count in _PRODUCTS])
        quantity = np.repeat(np.arange(len(_PRODUCTS)), 2 * np.array(_PRODUCTS))
        forms = self._combined()[:, quantity] * signs
        return np.kron(np.eye(len(self.points)), forms)

    def check(self, points: int) -> None:
        """Check the number of readings."""
        if points != _READINGS * len(self.points):
            accepted = f"must be the {_READINGS * len(self.points)} of the goal's ForceObjective"
            raise ValueError(f"pressure: {points} readings; {accepted}")

    @abstractmethod
    def _combined(self) -> Array:
        """Return the forms (J, 9) by force (3) and stiffness (6) at a point."""


def _particle_rows(field: Derivatives, alpha: float, beta: float) -> torch.Tensor:
    """Return the rows (P, 120, M) of force and stiffness, from derivatives at P points of unit drives.

    Each is a sum of products 2 c Re(u^* v): of two squares with opposite signs.
    """
    p, first, second, third = field
    products = []
    for j in range(3):
        products.append([(-alpha, p, first[..., j])])
        products[-1] += [(beta, first[..., i], second[..., i, j]) for i in range(3)]
    for j, k in _PAIRS:
        products.append([(alpha, first[..., k], first[..., j]), (alpha, p, second[..., j, k])])
        products[-1] += [(-beta, second[..., i, k], second[..., i, j]) for i in range(3)]
        products[-1] += [(-beta, first[..., i], third[..., i, j, k]) for i in range(3)]
    return torch.cat([_squares(each) for each in products], dim=1)


def _squares(products: Sequence[tuple[float, torch.Tensor, torch.Tensor]]) -> torch.Tensor:
    """Return rows (P, 2 C, M): of C sums and of C differences, of rows u and v (P, M) made equally large."""
    sums, differences = [], []
    for factor, u, v in products:
        sizes = [each.norm(dim=-1, keepdim=True).clamp_min(_TINY) for each in (u, v)]
        scale = (abs(factor) * sizes[1] / sizes[0]).sqrt()
        left, right = scale * u, factor / scale * v
        sums.append((left + right) / math.sqrt(2))
        differences.append((left - right) / math.sqrt(2))
    return torch.stack(sums + differences, dim=1)


def _along(directions: Array) -> Array:
    """Return n_i n_j of directions (D, 3) by the pairs of the stiffness (D, 6)."""
    return np.stack([(1 + (i != j)) * directions[:, i] * directions[:, j] for i, j in _PAIRS], axis=1)


@dataclass(frozen=True)
class Trap(_ParticleGoal):
    """The stiffness of traps of a small particle: the least one, over points and directions [N/m].

    From each stiffness, the force along the direction over `displacement` is subtracted. A score above 0
    means that the particle is pulled back along all directions, to a place within `displacement` of the
    point.

    Attributes:
        points: (P, 3) [m].
        particle: the particle.
        directions: (D, 3), along which it is held; by default 13, for all.
        displacement: largest distance along a direction from the point to the place of equilibrium [m], > 0.
    """

    name: ClassVar[str] = "trap"
    unit: ClassVar[str] = "N/m"

    def _combined(self) -> Array:
        directions = np.array(self.directions)
        stiffness, force = _along(directions), directions / self.displacement
        return np.concatenate([np.hstack([force, stiffness]), np.hstack([-force, stiffness])])


@dataclass(frozen=True)
class Levitate(_ParticleGoal):
    """The lift of a small particle in traps, in weights of it: 1 holds it, more is the margin.

    The score is the least of the upward force over the weight and, over directions, of the restoring force at
    `reach` over the weight, from which the sideways force times reach / displacement is subtracted. With a
    score of s >= 1, the drive times s^(-1/2) holds the particle within `displacement` of the point across
    gravity, and within `reach` along it if its weight doubles.

    Attributes:
        points: (P, 3) [m].
        particle: the particle.
        directions: (D, 3), along which it is held; by default 13, for all.
        displacement: largest sideways distance from the point to the place of equilibrium [m], > 0.
        reach: distance over which the stiffness must make up the weight [m], > 0; by default 2 mm, a quarter
        of
            the wavelength at 40 kHz.
        up: direction against gravity (3,); any length.
    """

    name: ClassVar[str] = "levitate"
    unit: ClassVar[str] = ""

    reach: float = 2e-3
    up: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Check the fields."""
        super().__post_init__()
        object.__setattr__(self, "reach", positive("reach", self.reach, "m"))
        object.__setattr__(self, "up", unit_vector("up", self.up))

    def _combined(self) -> Array:
        directions, up = np.array(self.directions), np.array(self.up)
        sideways = (directions - np.outer(directions @ up, up)) / self.displacement
        stiffness = _along(directions)
        restoring = [np.hstack([sideways, stiffness]), np.hstack([-sideways, stiffness])]
        lift = np.hstack([up, np.zeros(len(_PAIRS))])[None]
        return np.concatenate([lift, *(self.reach * part for part in restoring)]) / self.particle.weight


class ForceObjective:
    """An objective of forces: its readings are magnitudes, from whose squares a `ForceGoal` gives the score.

    Methods maximise its goal by default.

    Attributes:
        scene: its array plays the drives; its control points do not count.
        goal: the goal.
        evaluations: number of observations so far.
        transfer_matrix: the rows (N, M), complex128, of the readings; `goal.bound` takes them.
    """

    def __init__(self, propagator: Propagator, goal: ForceGoal) -> None:
        """Compute the rows of a goal by a propagator."""
        require_kind("propagator", propagator, Propagator)
        require_kind("goal", goal, ForceGoal)
        self.scene, self.goal, self.evaluations = propagator.scene, goal, 0
        self.transfer_matrix: torch.Tensor | None = goal.rows(propagator)

    @one_library_thread()
    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (..., M): readings (..., N), float64, on the CPU, without gradient."""
        return observe_drives(self._observe, drive, len(self.scene.array))

    def _observe(self, drive: torch.Tensor) -> torch.Tensor:
        self.evaluations += len(drive)
        assert self.transfer_matrix is not None
        return magnitudes(self.transfer_matrix, drive)
