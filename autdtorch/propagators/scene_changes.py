"""The transfer matrix of a scene as a function of named changes, and its derivatives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from autdtorch.propagators.free_space import FreeSpacePropagator
from autdtorch.propagators.propagator import Propagator, ScenePropagator
from autdtorch.propagators.simulated import SimulatedPropagator
from autdtorch.propagators.tmatrix.obstacle_groups import bodies_of
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.propagators.tmatrix.tmatrix import TMatrix, TMatrixCluster
from autdtorch.scene.changes import (
    Amounts,
    changed_and_seen,
    changed_array,
    changed_medium,
    changed_obstacles,
    changed_points,
    changed_reflectors,
    changed_scene,
    lever,
    move_of,
    require_change,
    unit_of,
)
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.moving import circumscribed
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.mirror_images import SPACE_ITSELF, Image
from autdtorch.utils.process import cached_property, one_library_thread
from autdtorch.utils.validation import ArrayLike, invalid, points_tensor, real_tensor

_STEP_OF_SUMS = 1e-7
"""Step of forward differences of exact sums [wavelengths]: their error is half its phase, 3e-7."""

_STEP_ON_GRIDS = 0.016
"""Step of central differences of simulations [wavelengths]: their error is its phase squared over 6, 0.2 %.
Runs end at a distance from the steady state, which needs a large step."""

_BETWEEN = 12.0
"""Kelvins between the temperatures at which T-matrices are simulated; others are interpolated by the nearest
three. For the paper's cubes, 6 K apart err by 7e-6, and the error grows with the cube."""

_ASIDE = 1e-6
"""Share of it by which the temperatures taken change before half of it, so that a small step from there takes
those of its start."""


class SceneChanges:
    """The transfer matrix of a scene as a function of the amounts of named changes.

    Names and units of amounts are those of `autdtorch.scene.changes.KINDS`; the scene itself has amounts of
    0. Each matrix is computed for the changed scene. T-matrices are moved, not simulated again;
    at other temperatures they are interpolated between simulations 12 K apart. Grids of method "box" turn
    with obstacles that turn as one body.

    Attributes:
        names: of the changes.
        units: of their amounts.
    """

    def __init__(self, propagator: Propagator, names: Sequence[str], points: ArrayLike | None = None) -> None:
        """Check the changes; nothing is simulated here.

        Args:
            propagator: of the scene, by `make_propagator`. Changed scenes are computed with its settings.
            names: of the changes, each once.
            points: points of observation (P, 3) [m], by default the scene's control points. Changes of
                "points" move these, and then not the control points.

        Raises:
            ValueError: a name that is unknown, or a change that the scene cannot make.
        """
        if not isinstance(propagator, ScenePropagator):
            raise invalid("propagator", type(propagator).__name__, "must be one that make_propagator makes")
        self._propagator, self._base = propagator, propagator.scene
        self._points = None if points is None else points_tensor("points", points).cpu()
        self.names = (names,) if isinstance(names, str) else tuple(names)
        count = len(self._base.control_points if self._points is None else self._points)
        for name in self.names:
            require_change(name, self._base, count)
        if len(set(self.names)) < len(self.names):
            raise invalid("names", self.names, "must be there once each")
        self.units = tuple(map(unit_of, self.names))
        self._last: tuple[Amounts, ScenePropagator, Image] | None = None

    def scene(self, amounts: ArrayLike) -> Scene:
        """Return the scene changed by amounts (K,).

        Raises:
            ValueError: amounts that make no scene, such as an obstacle moved onto a control point.
        """
        return changed_scene(self._base, self._of_scene(self._by_name(amounts)))

    def points(self, amounts: ArrayLike) -> torch.Tensor:
        """Return the points of observation (P, 3) [m] after changes by amounts (K,)."""
        return self._points_by(self._by_name(amounts))

    @one_library_thread()
    def matrix(self, amounts: ArrayLike) -> torch.Tensor:
        """Return the transfer matrix (P, M) [Pa] of the scene changed by amounts (K,)."""
        return self._matrix(self._by_name(amounts))

    @one_library_thread()
    def derivatives(self, amounts: ArrayLike) -> torch.Tensor:
        """Return the derivatives (K, P, M) of the transfer matrix by the amounts (K,), at these.

        They are differences of matrices: two more for each change or, where no body is simulated again, one.
        """
        named = self._by_name(amounts)
        if self._is_by_waves(named):
            return self._forward_differences(named)
        slopes = torch.zeros((len(named), len(self.points(amounts)), len(self._base.array)), **COMPLEX)
        for number, (name, amount) in enumerate(named.items()):
            step = _STEP_ON_GRIDS * self._base.wavelength / lever(name, self._base)
            upper, lower = (self._matrix(named | {name: amount + each}) for each in (step, -step))
            slopes[number] = (upper - lower) / (2 * step)
        return slopes

    def coarser(self, factor: float) -> SceneChanges:
        """Return the changes on grids whose cells are larger by a factor; the same where there are none."""
        if not isinstance(self._propagator, SimulatedPropagator):
            return self
        return SceneChanges(self._propagator.coarser(factor), self.names, self._points)

    @property
    def simulates(self) -> bool:
        """True if each matrix takes simulations on grids; sums over waves or sources take none."""
        return isinstance(self._propagator, SimulatedPropagator)

    def _is_by_waves(self, amounts: Amounts) -> bool:
        """Return whether sums over sources and waves of the same bodies serve all points."""
        if isinstance(self._propagator, FreeSpacePropagator):
            return True
        if self._bodies is None or not self._bodies.stay(amounts):
            return False
        propagator, _ = self._propagator_of(amounts)
        assert isinstance(propagator, TMatrixPropagator)
        return bool(propagator.by_waves(self._points_by(amounts))[1].all())

    def _forward_differences(self, amounts: Amounts) -> torch.Tensor:
        start = self._sums(amounts)
        slopes = torch.zeros((len(amounts), *start.shape), **COMPLEX)
        for number, (name, amount) in enumerate(amounts.items()):
            step = _STEP_OF_SUMS * self._base.wavelength / lever(name, self._base)
            if name == "radius" or name.endswith(".distance"):
                step = -step  # discs may touch, and points may lie in a plane
            slopes[number] = (self._sums({**amounts, name: amount + step}) - start) / step
        return slopes

    def _sums(self, amounts: Amounts) -> torch.Tensor:
        """Return the matrix of free space, or of moved bodies."""
        points = self._base.control_points if self._points is None else self._points
        return self._matrix(amounts) if self._bodies is None else self._bodies.matrix(points, amounts)

    def _matrix(self, amounts: Amounts) -> torch.Tensor:
        points = None if self._points is None else changed_points(self._points, amounts)
        propagator, view = self._propagator_of(amounts)
        return propagator.transfer_matrix(None if points is None else view.of(points))

    def _points_by(self, amounts: Amounts) -> torch.Tensor:
        return changed_points(self._base.control_points if self._points is None else self._points, amounts)

    def _of_scene(self, amounts: Amounts) -> Amounts:
        """Return the amounts of changes of the scene."""
        if self._points is None:
            return amounts
        return {name: each for name, each in amounts.items() if not name.startswith("points")}

    def _seen(self, amounts: Amounts) -> tuple[Scene, Image]:
        """Return the changed scene and the map from its places to those in it: as turned obstacles see it."""
        amounts, base, before = self._of_scene(amounts), self._base, self._propagator
        if len(base.obstacles) == 1 and not any(name.startswith("obstacles.") for name in amounts):
            amounts = {name.replace("obstacles[0].", "obstacles."): each for name, each in amounts.items()}
        on_grids = isinstance(before, SimulatedPropagator) and before.method == "box" and not base.reflectors
        if on_grids and any(move_of("obstacles", amounts)[1]):
            return changed_and_seen(base, amounts)
        return changed_scene(base, amounts), SPACE_ITSELF

    def _propagator_of(self, amounts: Amounts) -> tuple[ScenePropagator, Image]:
        """Return the propagator of the changed scene, and the map to its places; the last are at hand."""
        before = self._propagator
        if self._last is not None and self._last[0] == amounts:
            return self._last[1:]
        scene, view = self._seen(amounts)
        after: ScenePropagator
        if isinstance(before, TMatrixPropagator) and self._bodies and self._bodies.stay(amounts):
            after = before.for_scene(scene, self._bodies.cluster(amounts))
        else:
            after = before.for_scene(scene)
        self._last = dict(amounts), after, view
        return after, view

    @cached_property
    def _bodies(self) -> MovedBodies | None:
        return MovedBodies(self._propagator) if isinstance(self._propagator, TMatrixPropagator) else None

    def _by_name(self, amounts: ArrayLike) -> dict[str, float]:
        values = real_tensor("amounts", amounts).detach().cpu()
        if values.shape != (len(self.names),):
            raise ValueError(f"amounts: shape {tuple(values.shape)}; must be ({len(self.names)},), as names")
        return dict(zip(self.names, values.tolist(), strict=True))


class MovedBodies:
    """The bodies of a T-matrix propagator in a scene that changes: they move without further simulations."""

    def __init__(self, propagator: TMatrixPropagator) -> None:
        """Take the bodies of a propagator; nothing is simulated here."""
        self._propagator, self._scene = propagator, propagator.scene
        self._groups = [group.numbers for group in bodies_of(self._scene.obstacles)]
        self._matrices: dict[float, list[torch.Tensor]] = {}

    def stay(self, amounts: Amounts) -> bool:
        """Return whether the bodies stay what they are by changes: no obstacle moves within its body."""
        joined = [f"obstacles[{index}]" for group in self._groups if len(group) > 1 for index in group]
        if any(name.partition(".")[0] in joined for name in amounts):
            return False
        bodies = bodies_of(changed_obstacles(self._scene.obstacles, amounts))
        return [body.numbers for body in bodies] == self._groups

    def cluster(self, amounts: Amounts) -> TMatrixCluster:
        """Return the bodies after changes by amounts."""
        before, after = self._scene.medium, changed_medium(self._scene.medium, amounts)
        wavenumber = self._scene.wavenumber * before.sound_speed / after.sound_speed
        matrices = self._matrices_at(amounts.get("temperature", 0.0))
        bodies = [
            replace(body, matrix=matrix, wavenumber=complex(wavenumber, self._scene.attenuation))
            for body, matrix in zip(self._placed(amounts), matrices, strict=True)
        ]
        return TMatrixCluster(bodies, changed_reflectors(self._scene, amounts))

    def matrix(self, points: torch.Tensor, amounts: Amounts) -> torch.Tensor:
        """Return the transfer matrix (P, M) [Pa], by changes, of points (P, 3) [m] that waves serve."""
        array = changed_array(self._scene.array, amounts)
        return self.cluster(amounts).transfer_matrix(array, changed_points(points, amounts))

    def _placed(self, amounts: Amounts) -> list[TMatrix]:
        """Return the bodies moved on their own, then all as one."""
        alone = {name: amount for name, amount in amounts.items() if name.startswith("obstacles[")}
        pivot, _ = circumscribed(changed_obstacles(self._scene.obstacles, alone))
        shift, angles = move_of("obstacles", amounts)
        turn, placed = rotation_matrix(angles), []
        for body, group in zip(self._propagator.bodies.bodies, self._groups, strict=True):
            each = body.moved(*move_of(f"obstacles[{group[0]}]", amounts)) if len(group) == 1 else body
            center = pivot + turn @ (each.center - pivot) + shift
            placed.append(replace(each, center=center, axes=turn @ each.axes))
        return placed

    def _matrices_at(self, kelvin: float) -> list[torch.Tensor]:
        """Return the T of all bodies in air that is warmer [K], interpolated where they are simulated."""
        if not kelvin or not self._propagator.plan.runs:
            return self._exact_at(kelvin)
        middle = math.floor(kelvin / _BETWEEN + 0.5 + _ASIDE)
        place = kelvin / _BETWEEN - middle
        weights = torch.tensor([place * (place - 1) / 2, 1 - place**2, place * (place + 1) / 2], **COMPLEX)
        nodes = [self._exact_at(_BETWEEN * (middle + aside)) for aside in (-1, 0, 1)]
        return [torch.einsum("t,tnk->nk", weights, torch.stack(each)) for each in zip(*nodes, strict=True)]

    def _exact_at(self, kelvin: float) -> list[torch.Tensor]:
        """Return the T of all bodies in air that is warmer [K], of as many waves as at the start."""
        if kelvin not in self._matrices:
            start = self._propagator.bodies.bodies
            warmer = self._propagator.for_scene(changed_scene(self._scene, {"temperature": kelvin}))
            bodies = warmer.bodies.bodies if kelvin else start
            pairs = zip(bodies, start, strict=True)
            self._matrices[kelvin] = [_of_size(body.matrix, len(before.matrix)) for body, before in pairs]
        return self._matrices[kelvin]


def _of_size(matrix: torch.Tensor, count: int) -> torch.Tensor:
    """Return T with so many waves: those of the highest degree, below the tolerance, are cut or 0."""
    result = matrix.new_zeros((count, count))
    least = min(count, len(matrix))
    result[:least, :least] = matrix[:least, :least]
    return result
