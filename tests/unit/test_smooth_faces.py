"""Forces of the local fields at smooth surfaces."""

import numpy as np
import pytest

from autdtorch.fdtd.assembly.element import LATTICE, stiffness_matrix
from autdtorch.fdtd.assembly.smooth_faces import (
    Surface,
    face_forces,
    fields,
    forces,
    smooth_stiffness,
    surfaces,
)


def planes(ratio: float, normal: np.ndarray, depth: np.ndarray) -> Surface:
    """Return flat surfaces with normals (n, 3), at a signed distance (n,) from the centres."""
    level = depth[:, None] + normal @ (LATTICE - 0.5).T
    _, found = surfaces(level, np.tile((1.0, ratio), (len(depth), 1)))
    return found


def random_planes(ratio: float) -> Surface:
    random = np.random.default_rng(1)
    normal = random.normal(size=(200, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return planes(ratio, normal, random.uniform(-0.5, 0.5, 200))


RATIOS = pytest.mark.parametrize("ratio", [0.14, 1.5, 8.0, 77.0])


@RATIOS
def test_elements_sharing_a_face_get_opposite_forces(ratio: float) -> None:
    """No net force at the vertices of flat surfaces, for all fields along the surface and across it."""
    here = random_planes(ratio)
    middle = here.level[:, len(LATTICE) // 2]
    for axis in range(3):
        beyond = planes(ratio, here.normal, middle + here.normal[:, axis])
        assert np.allclose(face_forces(here, 2 * axis + 1), -face_forces(beyond, 2 * axis), atol=1e-11)


@RATIOS
def test_stiffness_gives_the_fields_their_forces(ratio: float) -> None:
    here = random_planes(ratio)
    uniform, mobility = np.full(28, 0.1), np.full((200, 64), 1 / 64)
    coupling, weight = smooth_stiffness(here, mobility, np.tile(uniform, (200, 1)), uniform)
    assert (weight == 1).mean() > 0.99  # the others' energy would not be positive
    matrix, local, force = stiffness_matrix(coupling), fields(here), forces(here)
    own = weight == 1
    assert np.allclose((matrix @ local)[own], force[own], atol=1e-9)
    assert np.linalg.eigvalsh(matrix).min() > -1e-9


def test_in_one_material_forces_are_those_of_linear_pressures() -> None:
    here = random_planes(1.0)
    slope = np.concatenate((here.tangents, here.normal[:, None]), axis=1)
    at_vertices = np.array(list(np.ndindex((2,) * 3))) - 0.5
    # half of the flow through each face that a vertex touches: a quarter of it, from each of three faces
    assert np.allclose(forces(here), at_vertices @ slope.transpose(0, 2, 1) / 2, atol=0.01)
