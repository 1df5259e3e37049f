"""The live view as a program uses it: scene and drive are read and set, and results waited for."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from live_view import SPACING, opened, pressures, settled, share_of_bound, simulated, wait_for

import autdtorch as at
from autdtorch.plot.explore import calculation
from autdtorch.plot.explore.picture import Grip
from autdtorch.plot.view3d import rendering_problem

pytest.importorskip("trame_rca", reason="trame: install autdtorch[explore]")


@pytest.fixture
def view(scene):
    """A live view that no browser shows."""
    if problem := rendering_problem():
        pytest.skip(problem)
    explorer = at.explore(scene, spacing=SPACING)
    yield explorer
    explorer.close()


def test_a_notebook_that_runs_all_cells_has_the_drive(view, scene):
    view.ready()
    assert share_of_bound(view) > 0.97
    drive = view.drive
    view.scene = replace(scene, obstacles=scene.obstacles[1:])
    view.ready()
    assert len(view.scene.obstacles) == 1
    assert torch.equal(view.drive, drive)  # as if the obstacle had been moved
    view.scene = replace(scene, array=at.TransducerArray.grid((3, 5), 10e-3, (1e-3, 50e-3, 50e-3)))
    view.ready()
    assert len(view.drive) == 15
    assert share_of_bound(view) > 0.97


def test_a_drive_that_is_set_ends_the_search(view):
    mine = torch.exp(1j * torch.linspace(0, 3, 16, dtype=torch.float64))
    view.drive = mine
    view.ready()
    assert torch.equal(view.drive, mine)


def test_the_page_shows_what_is_set_and_undoes_it(view, scene, browser):
    other = at.Cylinder((35e-3, 20e-3, 50e-3), 5e-3, 30e-3, rigid=True)
    with opened(browser, view) as page:
        before = page.locator("#body option").all_text_contents()
        with settled(page):
            view.scene = replace(scene, obstacles=(*scene.obstacles, other), name="three")
        assert page.locator("#body option").all_text_contents() == [*before, "2: cylinder"]
        assert "three" in page.title()
        with settled(page):
            view.drive = torch.ones(16, dtype=torch.complex128)
        np.testing.assert_allclose(pressures(page), simulated(view), rtol=1e-2)
        page.click("#undo")
        with settled(page):
            page.click("#undo")
        assert view.scene is scene
        wait_for(lambda: page.locator("#body option").all_text_contents() == before)


def test_what_cannot_be_set_changes_nothing(view, scene):
    view.ready()
    drive = view.drive
    with pytest.raises(ValueError, match="scene"):
        view.scene = "two_cubes"
    too_coarse = replace(scene, medium=at.Medium.air(frequency=90e3), frequency=90e3)
    with pytest.raises(ValueError, match="spacing"):
        view.scene = too_coarse
    for wrong in (drive[:3], 2 * drive, float("nan") * drive):
        with pytest.raises(ValueError, match="drive"):
            view.drive = wrong
    assert view.scene is scene
    assert torch.equal(view.drive, drive)
    view.close()
    with pytest.raises(RuntimeError, match="closed"):
        view.drive = drive
    with pytest.raises(RuntimeError, match="closed"):
        view.ready()


def test_a_view_that_closes_before_it_comes_to_a_call_says_so(view, scene, monkeypatch):
    view.ready()
    server = view._server
    monkeypatch.setattr(server, "_call", lambda *_: view.close())  # after the check that it runs
    with pytest.raises(RuntimeError, match="closed"):
        view.scene = scene


def in_session(view, act):
    """Call a function of the session in its thread."""
    view._server.call(lambda: act(view._application.session))


def test_the_view_follows_though_the_search_before_failed(view, monkeypatch):
    view.ready()
    begun, may_fail = threading.Event(), threading.Event()

    def fail(*_):
        begun.set()
        may_fail.wait()
        raise RuntimeError("no drive today")

    monkeypatch.setattr(calculation.Calculator, "_steps", fail)
    in_session(view, lambda session: session.find())
    assert begun.wait(10)

    def look_elsewhere(session):
        session.attempt(lambda: session.now.with_plane("z"), moving=False)
        session.settle()

    in_session(view, look_elsewhere)
    may_fail.set()
    with pytest.raises(RuntimeError, match="no drive today"):
        view.ready()
    session = view._application.session
    assert session.display.result.request.situation.plane == "z"


def test_the_mouse_lets_go_of_what_another_scene_has_no_more(view, scene):
    def hold_the_last_body(session):
        place = np.array(session.now.bodies[-1].center)
        session.grip = Grip("body", 1, place, place)

    for change in (
        lambda: setattr(view, "scene", replace(scene, obstacles=scene.obstacles[:1])),
        lambda: in_session(view, lambda session: session.undo()),
        lambda: in_session(view, lambda session: session.redo()),
    ):
        in_session(view, hold_the_last_body)
        change()
        assert view._application.session.grip is None


def test_the_camera_stays_where_the_domain_does(view, scene):
    def camera():
        picture = view._application.session.display.picture
        return np.array([*picture.plotter.camera_position[0], picture.plotter.camera.parallel_scale])

    first = camera()
    in_session(view, lambda session: session.display.picture.move_camera(30.0, 10.0, 1.5))
    turned = camera()
    assert np.abs(turned - first).max() > 1
    view.scene = replace(scene, obstacles=scene.obstacles[:1])
    np.testing.assert_allclose(camera(), turned, rtol=1e-9)
    view.scene = replace(scene, domain=[[0, 0, 0], [0.1, 0.1, 0.11]])
    assert np.abs(camera() - turned).max() > 1


def test_who_waits_is_told_why_there_is_no_result(view, monkeypatch):
    view.ready()

    def fail(*_):
        raise RuntimeError("no field today")

    monkeypatch.setattr(calculation, "_field", fail)
    view.drive = -view.drive
    with pytest.raises(RuntimeError, match="no field today"):
        view.ready()
    monkeypatch.undo()
    view.drive = -view.drive
    view.ready()
