"""The transfer matrix of a scene as a function of named changes, and its derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from autdtorch.propagators.free_space import FreeSpacePropagator
from autdtorch.propagators.simulated import Propagator, SimulatedPropagator
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.scene.changes import Amounts, changed_points, changed_scene, lever, require_change, unit_of
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.process import cached_property
from autdtorch.utils.validation import ArrayLike, invalid, points_tensor, real_tensor

_STEP_OF_SUMS, _STEP_ON_GRIDS = 1e-4, 0.016
"""Steps of central differences [wavelengths], which they shift something by: their error is their phase
squared over 6, 7e-8 and 0.2 %. Runs on grids end at a distance from the steady state, which needs the larger
one."""


class SceneChanges:
    """The transfer matrix of a scene as a function of the amounts of named changes.

    Names and units of amounts are those of `autdtorch.scene.changes.KINDS`; the scene itself has amounts of
    0. A matrix is that of the changed scene, not an extrapolation.

    Attributes:
        names: of the changes.
        units: of their amounts.
    """

    def __init__(
        self,
        propagator: Propagator,
        names: Sequence[str],
        points: ArrayLike | None = None,
    ) -> None:
        """Check the changes; nothing is simulated here.

        Args:
            propagator: of the scene, by `make_propagator`. Changed scenes are computed with its settings.
            names: of the changes, each once.
            points: points of observation (P, 3) [m], by default the scene's control points. Changes of
                "points" move these, and then not the control points.

        Raises:
            ValueError: a name that is unknown, or a change that the scene cannot make.
        """
        if not isinstance(propagator, FreeSpacePropagator | TMatrixPropagator | SimulatedPropagator):
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

    def scene(self, amounts: ArrayLike) -> Scene:
        """Return the scene changed by amounts (K,).

        Raises:
            ValueError: amounts that make no scene, such as an obstacle moved onto a control point.
        """
        return self._scene(self._by_name(amounts))

    def points(self, amounts: ArrayLike) -> torch.Tensor:
        """Return the points of observation (P, 3) [m] after changes by amounts (K,)."""
        points = self._base.control_points if self._points is None else self._points
        return changed_points(points, self._by_name(amounts))

    def matrix(self, amounts: ArrayLike) -> torch.Tensor:
        """Return the transfer matrix (P, M) [Pa] of the scene changed by amounts (K,)."""
        return self._matrix(self._by_name(amounts))

    def derivatives(self, amounts: ArrayLike) -> torch.Tensor:
        """Return the derivatives (K, P, M) of the transfer matrix by the amounts (K,), at these."""
        named = self._by_name(amounts)
        points = len(self.points(amounts))
        slopes = torch.zeros((len(named), points, len(self._base.array)), **COMPLEX)
        for number, (name, amount) in enumerate(named.items()):
            step = self._steps[name]
            upper, lower = (self._matrix(named | {name: amount + each}) for each in (step, -step))
            slopes[number] = (upper - lower) / (2 * step)
        return slopes

    def _matrix(self, amounts: Amounts) -> torch.Tensor:
        points = None if self._points is None else changed_points(self._points, amounts)
        return self._propagator_of(self._scene(amounts)).transfer_matrix(points)

    def _scene(self, amounts: Amounts) -> Scene:
        if self._points is not None:
            amounts = {name: each for name, each in amounts.items() if not name.startswith("points")}
        return changed_scene(self._base, amounts)

    def _propagator_of(self, scene: Scene) -> FreeSpacePropagator | TMatrixPropagator | SimulatedPropagator:
        """Return the propagator of a changed scene."""
        before = self._propagator
        return FreeSpacePropagator(scene) if isinstance(before, FreeSpacePropagator) else before.of(scene)

    @cached_property
    def _steps(self) -> dict[str, float]:
        """Steps of differences, by name."""
        simulates = not isinstance(self._propagator, FreeSpacePropagator | TMatrixPropagator)
        step = (_STEP_ON_GRIDS if simulates else _STEP_OF_SUMS) * self._base.wavelength
        return {name: step / lever(name, self._base) for name in self.names}

    def _by_name(self, amounts: ArrayLike) -> dict[str, float]:
        values = real_tensor("amounts", amounts).detach().cpu()
        if values.shape != (len(self.names),):
            raise ValueError(f"amounts: shape {tuple(values.shape)}; must be ({len(self.names)},), as names")
        return dict(zip(self.names, values.tolist(), strict=True))
