"""One live view that all tests in a browser share; each begins with the first scene and drive."""

import pytest
from live_view import SPACING, in_session, opened, wait_for_fine, wait_in_page

import autdtorch as at
from autdtorch.plot.view3d import rendering_problem


@pytest.fixture(scope="session")
def scene():
    """Two obstacles that are not alike, so that a mirrored picture is another."""
    array = at.TransducerArray.grid((4, 4), 10e-3, (1e-3, 50e-3, 50e-3))
    foci = at.circle_points((80e-3, 50e-3, 50e-3), 25e-3, 3, (1, 0, 0))
    obstacles = (
        at.Box((40e-3, 45e-3, 50e-3), (14e-3,) * 3, rigid=True),
        at.Sphere((30e-3, 70e-3, 60e-3), 4e-3, rigid=True),
    )
    plane = at.Plane((80e-3, 50e-3, 50e-3), (1, 0, 0), (100e-3, 100e-3))
    air, domain = at.Medium.air(frequency=20e3), [[0, 0, 0], [0.1, 0.1, 0.1]]
    return at.Scene(array, air, 20e3, foci, obstacles, plane, domain, name="cube and sphere")


@pytest.fixture(scope="session")
def shared(scene):
    """A live view, the first drive that it finds, and the calculated fields of the first scene."""
    pytest.importorskip("trame_rca", reason="trame: install autdtorch[explore]")
    if problem := rendering_problem():
        pytest.skip(problem)
    explorer = at.explore(scene, spacing=SPACING)
    explorer.ready()
    yield explorer, explorer.drive, dict(explorer._application.session._calculator._propagators)
    explorer.close()


@pytest.fixture
def view(shared, scene):
    """The shared live view, begun again with the first scene and drive."""
    from autdtorch.plot.explore.display import first_state
    from autdtorch.plot.explore.situation import History, Situation

    explorer, drive, propagators = shared
    first = Situation.of(scene, drive)

    def begin_again(session):
        session.cancel()
        session._calculator._propagators = dict(propagators)  # calculated once, not again for each test
        session.grip, session._history = None, History(first)
        state = first_state(first, session.methods)
        session._state.update({name: state[name] for name in state.keys() - {"shown", "wanted"}})
        session.display.surface = state["surface"]
        session.display.silent.clear()
        session.display.picture.move_camera(0, 0, 0)
        session.place()
        session.look()

    in_session(explorer, begin_again)
    explorer.ready()
    return explorer


@pytest.fixture(scope="module")
def first_page(shared, browser):
    """A page for all tests of a file: to open it takes a second."""
    with opened(browser, shared[0]) as page:
        yield page


@pytest.fixture
def live(view, first_page):
    """The shared live view and its page, scrolled up and begun again too."""
    first_page.evaluate("document.activeElement.blur(); scrollTo(0, 0)")
    numbers = []
    in_session(view, lambda session: numbers.append(session._state.shown))
    is_there = "number => document.querySelector('section.picture').dataset.shown === `${number}`"
    wait_in_page(first_page, is_there, numbers[0])
    wait_for_fine(first_page)
    return view, first_page
