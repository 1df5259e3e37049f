"""The live view as a program uses it: scene and drive are read and set, and results waited for."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from live_view import SPACING, opened, pressures, settled, share_of_bound, simulated, wait_for

import autdtorch as at
from autdtorch.plot.explore import calculation
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
    with pytest.raises(ValueError, match="spacing"):
        view.scene = replace(scene, frequency=90e3, medium=at.Medium(1.2, 343.0))  # too coarse cells
    for wrong in (drive[:3], 2 * drive, float("nan") * drive):
        with pytest.raises(ValueError, match="drive"):
            view.drive = wrong
    assert view.scene is scene
    assert torch.equal(view.drive, drive)
    view.close()
    with pytest.raises(RuntimeError, match="closed"):
        view.drive = drive


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
