"""Elements at edges of rigid bodies, fitted at the drive's frequency."""

import numpy as np
import pytest

from autdtorch.fdtd.assembly.edge_fit import fitted_couplings
from autdtorch.fdtd.assembly.edge_waves import _WaveWindow, at_the_drive, rigid_corner
from autdtorch.fdtd.assembly.prisms import prisms
from autdtorch.fdtd.assembly.reference_element import stiffness_matrix
from autdtorch.fdtd.assembly.sections import COLUMN_PAIRS, MaterialKey, Section, plane_fields
from autdtorch.fdtd.stencil import tuned_stencil

RIGID = MaterialKey((1.0, 1e12), (1.0, 1e-12), (False, True))


def corner(x, y, rigid=(0, 0)):
    """A section whose block at `rigid` is rigid, with faces at x and y."""
    blocks = np.zeros((2, 2), int)
    blocks[rigid] = 1
    return Section(((x,), (y,)), tuple(map(tuple, blocks.tolist())))


@pytest.mark.parametrize("kappa", [0.7, 0.85, 1.25])
@pytest.mark.parametrize("place", [(0.5, 0.5), (0.6, 0.5), (0.3, 0.6)])
def test_waves_around_an_edge_miss_less_than_those_of_elements_for_long_waves(place, kappa):
    """Half as far at most, at 9 to 5 cells per wavelength; half-way between cells a quarter."""
    section, stencil = corner(*place), tuned_stencil(kappa)
    coupling = fitted_couplings(section, plane_fields(section, RIGID.mobility, 8), RIGID, stencil)
    window, missed = _WaveWindow(section, (0, 0), RIGID, stencil), []
    mass = np.append(0.0, np.full(3, (1 - place[0] * place[1]) / 3))
    for values in ((coupling, mass), at_the_drive(section, (0, 0), coupling, mass, RIGID, stencil)):
        missed.append(np.linalg.norm(window.missed(*values)[0]))
    assert missed[1] < (0.3 if place == (0.5, 0.5) else 0.5) * missed[0]


@pytest.mark.parametrize("rigid", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_the_corner_may_be_any_block(rigid):
    section, turned = corner(0.3, 0.6), corner(abs(rigid[0] - 0.3), abs(rigid[1] - 0.6), rigid)
    assert rigid_corner(turned, RIGID) == rigid
    first, other = (prisms(each, RIGID, tuned_stencil(0.7)) for each in (section, turned))
    axes = [axis for axis in (0, 1) if rigid[axis]]
    np.testing.assert_allclose(np.flip(other.mass, axes), first.mass, rtol=1e-6)


SLIVERS = [(0.98, 0.98), (0.9, 0.95), (0.0209, 0.9673), (0.6668, 0.0266)]


@pytest.mark.parametrize("cells", [3.0, 6.0, 10.03, 40.0])
@pytest.mark.parametrize("place", SLIVERS + np.random.default_rng(0).uniform(0.02, 0.98, (4, 2)).tolist())
def test_elements_have_a_positive_energy_and_the_mass_of_their_volume(place, cells):
    """Also slivers of air, at few and at many cells per wavelength; rounding."""
    stencil = tuned_stencil(2 * np.pi / cells)
    element = prisms(corner(*place), RIGID, stencil)
    assert element.mass.sum() == pytest.approx(1 - place[0] * place[1], abs=1e-3)
    assert (element.mass >= 0).all()
    eigenvalues = np.linalg.eigvalsh(stiffness_matrix(element.coupling, COLUMN_PAIRS))
    assert eigenvalues.min() > -1e-12 * eigenvalues.max()
