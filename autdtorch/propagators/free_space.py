"""The transfer matrix and the propagator of free space."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import torch

from autdtorch.fdtd.kernels.waves import (
    AT_ONCE,
    WORTH_A_GPU,
    is_differentiated,
    superposition_on,
    waves_on_device,
)
from autdtorch.propagators.absorbed_power import AbsorbedPower, power_into_reflectors, radiators_of_array
from autdtorch.propagators.propagator import ScenePropagator
from autdtorch.scene.arrays import TransducerArray, apertures_of, complex_strengths_of
from autdtorch.scene.checks import require_clear
from autdtorch.scene.reflectors import require_in_front
from autdtorch.scene.scene import Scene
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.mirror_images import NO_MIRRORS, Image
from autdtorch.utils.process import one_library_thread, require_memory
from autdtorch.utils.text import counted
from autdtorch.utils.validation import ArrayLike, device_type, differentiable_points, require_kind

logger = logging.getLogger(__name__)

PAIR_BYTES = 48.0
"""Memory for each entry of a transfer matrix while it is computed [bytes]."""

_FEW = 100_000
"""Pairs of a point and a transducer up to which no compiled code is loaded: 0.02 s."""


def free_space_matrix(
    points: ArrayLike, array: TransducerArray, wavenumber: complex, images: Sequence[Image] = NO_MIRRORS
) -> torch.Tensor:
    """Return the transfer matrix (P, M), complex128, of an array without obstacles: S e^{i k r} / r (Eq. 2).

    The mean of it over discs. On the device of the points (P, 3) [m], and differentiable by them; pressure
    [Pa] per unit drive. `images` are those of the space in reflectors, `Scene.images`.

    Raises:
        ValueError: points have another shape, or one is on a transducer.
    """
    points = differentiable_points("points", points)
    require_clear(array, "points", points.detach())
    require_memory("points", tuple(points.shape), PAIR_BYTES * len(points) * len(array))
    transducers, amplitude = _sources_of(array, images)
    count = len(array)
    if len(points) * len(amplitude) > _FEW and points.device.type == "cpu" and not is_differentiated(points):
        from autdtorch.fdtd.kernels.cpu_waves import wave_matrix  # loads numba

        return wave_matrix(points.detach(), transducers.places, amplitude, count, wavenumber)

    def rows(some: torch.Tensor) -> torch.Tensor:
        matrix = torch.zeros((), **COMPLEX).to(points.device)
        for first in range(0, len(amplitude), count):  # image by image, with memory for one
            part = slice(first, first + count)
            waves = waves_on_device(some, transducers.chosen(part).places, wavenumber)
            matrix = matrix + amplitude[part].to(points.device) * waves
        return matrix

    return torch.cat([rows(some) for some in torch.split(points, max(1, AT_ONCE // count))])


def _sources_of(array: TransducerArray, images: Sequence[Image]) -> tuple[Apertures, torch.Tensor]:
    """Return all images of an array's transducers, one image after the other, and amplitudes [Pa m]."""
    transducers, weights = apertures_of(array).with_images(images)
    return transducers, weights * complex_strengths_of(array).repeat(len(weights) // len(array))


class FreeSpacePropagator(ScenePropagator):
    """The exact field of the array without obstacles, which are ignored; reflectors are not.

    Attributes:
        scene: the scene it was made for.
        device: "cpu" or "cuda", where fields of many points are summed.
    """

    def __init__(self, scene: Scene, device: torch.device | str | None = None) -> None:
        """Make the propagator of a scene, by default on the CPU; ignored obstacles are logged.

        Raises:
            ValueError: an unknown or missing device.
        """
        require_kind("scene", scene, Scene)
        self.scene, self.device = scene, device_type("device", device) or "cpu"
        if scene.obstacles:
            count = len(scene.obstacles)
            logger.warning("free_space ignores %s of scene %r", counted(count, "obstacle"), scene.name)

    def __repr__(self) -> str:
        return f"FreeSpacePropagator(scene {self.scene.name!r})"

    def for_scene(self, scene: Scene) -> FreeSpacePropagator:
        """Return the propagator of a changed scene."""
        return FreeSpacePropagator(scene, self.device)

    def _matrix(self, points: ArrayLike | None, with_error: bool) -> tuple[torch.Tensor, float]:
        scene = self.scene
        points = differentiable_points("points", scene.control_points if points is None else points)
        require_in_front(scene.reflectors, "points", points)
        matrix = free_space_matrix(points, scene.array, scene.complex_wavenumber, scene.images)
        return matrix, math.inf if scene.obstacles else 0.0

    def _field(self, drive: torch.Tensor, points: torch.Tensor, is_picture: bool) -> torch.Tensor:
        if self.device == "cuda" and len(points) * len(self.scene.array) >= WORTH_A_GPU:
            return self._summed(drive, points)
        matrix, _ = self._matrix(points, with_error=False)
        with one_library_thread():  # BLAS rounds by the number of threads
            return drive @ matrix.mT

    def _summed(self, drive: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Return the pressure (..., P) of drives (..., M), summed on the device without the matrix."""
        scene = self.scene
        require_in_front(scene.reflectors, "points", points.detach())
        require_clear(scene.array, "points", points.detach())
        transducers, amplitude = _sources_of(scene.array, scene.images)
        played = drive.reshape(-1, drive.shape[-1]).mT
        amplitude = amplitude[:, None] * played.repeat(len(amplitude) // len(played), 1)
        field = superposition_on(self.device, points, transducers.places, amplitude, scene.complex_wavenumber)
        return field.cpu().mT.reshape(*drive.shape[:-1], len(points))

    def _absorbed(self, drive: torch.Tensor) -> AbsorbedPower:
        power = power_into_reflectors(self.scene, [radiators_of_array(self.scene, drive)], len(drive))
        return AbsorbedPower(torch.zeros((len(drive), len(self.scene.obstacles)), **REAL), power)
