"""Live views that tests in a browser share."""

import pytest
from live_view import SPACING, opened

import autdtorch as at
from autdtorch.plot.view3d import rendering_problem


@pytest.fixture(scope="session")
def scene():
    """Two cubes that are not alike, so that a mirrored picture is another."""
    array = at.TransducerArray.grid((4, 4), 10e-3, (1e-3, 50e-3, 50e-3))
    foci = at.circle_points((80e-3, 50e-3, 50e-3), 25e-3, 3, (1, 0, 0))
    cubes = (
        at.Box((40e-3, 45e-3, 50e-3), (14e-3,) * 3, density=100.0, sound_speed=340.0),
        at.Sphere((30e-3, 70e-3, 60e-3), 4e-3, rigid=True),
    )
    plane = at.Plane((80e-3, 50e-3, 50e-3), (1, 0, 0), (100e-3, 100e-3))
    domain = [[0, 0, 0], [0.1, 0.1, 0.1]]
    return at.Scene(array, at.Medium.air(), 40e3, foci, cubes, plane, domain, name="cube and sphere")


@pytest.fixture
def live(scene, browser):
    """A live view of the scene, and its page in a browser, when the first drive is found."""
    if problem := rendering_problem():
        pytest.skip(problem)
    explorer = at.explore(scene, spacing=SPACING)
    with opened(browser, explorer) as page:
        yield explorer, page
    explorer.close()


@pytest.fixture(scope="session")
def unchanged(scene):
    """A live view that tests share, since they leave scene and drive as they are."""
    if problem := rendering_problem():
        pytest.skip(problem)
    explorer = at.explore(scene, spacing=SPACING)
    yield explorer
    explorer.close()
