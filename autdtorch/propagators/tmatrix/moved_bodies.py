"""The T-matrices of a scene's bodies as functions of the amounts of named changes."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from autdtorch.propagators.tmatrix.bodies import bodies_of
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.propagators.tmatrix.tmatrix import TMatrix, TMatrixCluster
from autdtorch.scene.changes import (
    Amounts,
    changed_array,
    changed_medium,
    changed_obstacles,
    changed_points,
    changed_reflectors,
    changed_scene,
    move_of,
)
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.moving import circumscribed
from autdtorch.utils.array_types import COMPLEX

_BETWEEN = 12.0
"""Kelvins between the temperatures at which T-matrices are simulated; others are interpolated by the nearest
three. For the paper's cubes, 6 K apart err by 7e-6, and the error grows with the cube."""

_ASIDE = 1e-6
"""Share of it by which the temperatures taken change before half of it, so that a small step from there takes
those of its start."""


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
