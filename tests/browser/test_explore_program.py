"""The live view as a program uses it: scene and drive are read and set, and results waited for."""

import gc
import re
import signal
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from live_view import PATIENCE, SPACING, in_session, share_of_bound, wait_for

import autdtorch as at
from autdtorch.hardware import Picture
from autdtorch.io.picture_file import PICTURES
from autdtorch.plot.explore import calculation
from autdtorch.plot.explore.rendering import Grip
from autdtorch.plot.explore.trial_pictures import TrialPictures


def test_a_notebook_that_runs_all_cells_has_the_drive(view, scene):
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
    in_session(view, lambda session: session.find())
    view.drive = mine
    view.ready()
    assert torch.equal(view.drive, mine)


def test_the_pictures_of_a_trial_are_shown_beside_the_simulation_of_their_drives(view, scene, tmp_path):
    plane, drive = scene.observation_plane, torch.exp(1j * torch.linspace(0, 3, 16, dtype=torch.float64))
    pictures, state = TrialPictures(tmp_path), []

    def follow(session):
        session._pictures = pictures
        session._look_for_pictures(pictures)
        state.append(session._state)

    in_session(view, follow)
    field = at.make_propagator(scene, spacing=SPACING).field(drive, plane.points(4e-3)).abs()
    picture = Picture(plane, 1.2 * field, 0.01 * field, doubts=("a frame is missing",))
    at.save_picture(tmp_path / PICTURES / "evaluation_00000.npz", picture, drive)
    try:
        wait_for(lambda: state[0].camera)
        view.ready()
        assert torch.equal(view.drive, drive)
        assert state[0].camera.startswith("data:image/png;base64,")
        # cells of 4 mm are compared by splines with others of about 2 mm
        assert re.search(r"times 1\.(2|19|21) differs by 0?\.?\d+ %", state[0].camera_text)
        assert state[0].camera_text.endswith(" a frame is missing.")
        (tmp_path / PICTURES / "evaluation_00001.npz").write_bytes(b"broken")
        wait_for(lambda: "evaluation_00001.npz" in state[0].message)
    finally:
        in_session(view, lambda session: setattr(session, "_pictures", None))


def test_what_cannot_be_set_changes_nothing(view, scene):
    drive = view.drive
    with pytest.raises(ValueError, match="scene"):
        view.scene = "two_cubes"
    too_coarse = replace(scene, medium=at.Medium.air(frequency=90e3), frequency=90e3)
    with pytest.raises(ValueError, match="spacing"):
        view.scene = too_coarse
    with pytest.raises(ValueError, match="spacing"):
        at.explore(scene, spacing=12e-3)
    for wrong in (drive[:3], 2 * drive, float("nan") * drive):
        with pytest.raises(ValueError, match="drive"):
            view.drive = wrong
    assert view.scene is scene
    assert torch.equal(view.drive, drive)


@pytest.mark.usefixtures("shared")  # which skips where nothing can be shown
def test_views_may_be_opened_by_several_threads_and_say_that_they_are_closed(scene, monkeypatch):
    with ThreadPoolExecutor(2) as threads:
        futures = [threads.submit(at.explore, scene, spacing=SPACING) for _ in range(2)]
    one, other = (future.result() for future in futures)
    assert one.address != other.address
    one.close()
    with pytest.raises(RuntimeError, match="closed"):
        one.drive = torch.ones(16, dtype=torch.complex128)
    with pytest.raises(RuntimeError, match="closed"):
        one.ready()
    monkeypatch.setattr(other._server, "_call", lambda *_: other.close())  # after the check that it runs
    with pytest.raises(RuntimeError, match="closed"):
        other.scene = scene


@pytest.mark.usefixtures("shared")
def test_ctrl_c_in_a_wait_leaves_a_view_and_it_ends_with_its_last_reference(scene):
    """A calculation that runs on while Python ends aborts the program."""
    live = at.explore(scene, spacing=SPACING)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
    try:
        with pytest.raises(KeyboardInterrupt):  # noqa: PT012 - the signal may come before the wait
            threading.Timer(0.5, signal.raise_signal, [signal.SIGINT]).start()
            live.wait()
    finally:
        signal.signal(signal.SIGINT, before)
    live.scene = live.scene  # the server answers
    server, reference = live._server, weakref.ref(live)
    del live
    gc.collect()
    assert reference() is None
    assert not server.running


def test_the_view_follows_though_the_search_before_failed(view, monkeypatch):
    begun, may_fail = threading.Event(), threading.Event()

    def fail(*_):
        begun.set()
        may_fail.wait()
        raise RuntimeError("no drive today")

    monkeypatch.setattr(calculation.Calculator, "_steps", fail)
    in_session(view, lambda session: session.find())
    assert begun.wait(PATIENCE)

    def look_elsewhere(session):
        session.attempt(lambda: session.now.with_plane("z"), moving=False)
        session.settle()

    in_session(view, look_elsewhere)
    may_fail.set()
    with pytest.raises(RuntimeError, match="no drive today"):
        view.ready()
    assert view._application.session.display.result.request.situation.plane == "z"


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
    def fail(*_):
        raise RuntimeError("no field today")

    monkeypatch.setattr(calculation, "_field", fail)
    view.drive = -view.drive
    with pytest.raises(RuntimeError, match="no field today"):
        view.ready()
    monkeypatch.undo()
    view.drive = -view.drive
    view.ready()
