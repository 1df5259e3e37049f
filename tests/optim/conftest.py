import pytest
import torch

from autdtorch.objectives.objective import SimulatedObjective
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.scene import Medium, Scene


class MatrixPropagator:
    """A propagator of which nothing is known but its transfer matrix."""

    def __init__(self, scene, matrix):
        self.scene = scene
        self._matrix = matrix

    def transfer_matrix(self, points=None):
        return self._matrix

    def field(self, drive, points):
        return drive @ self._matrix.T


@pytest.fixture(scope="session")
def make_objective():
    """Objective of any transfer matrix (P, M): transducers in a row, control points in one 80 mm away."""

    def make(matrix):
        points, transducers = matrix.shape
        positions = torch.zeros(transducers, 3, dtype=torch.float64)
        positions[:, 1] = 10e-3 * torch.arange(transducers)
        control_points = torch.zeros(points, 3, dtype=torch.float64)
        control_points[:, 0], control_points[:, 1] = 80e-3, 12e-3 * torch.arange(points)
        array = TransducerArray(positions, (1.0, 0.0, 0.0))
        scene = Scene(array, Medium(1.2, 340.0), frequency=40e3, control_points=control_points)
        return SimulatedObjective(scene, MatrixPropagator(scene, matrix))

    return make


@pytest.fixture(scope="session")
def random_matrix():
    """Transfer matrix (points, transducers) without any structure."""

    def make(points, transducers, seed):
        generator = torch.Generator().manual_seed(seed)
        return torch.randn(points, transducers, dtype=torch.complex128, generator=generator)

    return make


@pytest.fixture
def objective(make_objective, random_matrix):
    return make_objective(random_matrix(3, 5, 0))


@pytest.fixture(scope="session")
def paper_objective():
    """The paper's array and four foci in empty air."""
    from autdtorch.propagators.free_space import free_space_matrix
    from autdtorch.scene.geometry import circle_points

    array = TransducerArray.grid((4, 4), pitch=10e-3, center=(1e-3, 50e-3, 50e-3))
    foci = circle_points(center=(80e-3, 50e-3, 50e-3), radius=30e-3, count=4, normal=(1, 0, 0))
    scene = Scene(array, Medium(1.293, 340.0), frequency=40e3, control_points=foci)
    return SimulatedObjective(
        scene, MatrixPropagator(scene, free_space_matrix(foci, array, scene.wavenumber))
    )
