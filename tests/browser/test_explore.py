"""The live view in a real browser: what a user does there changes scene, drive and picture."""

import threading
from dataclasses import replace

import numpy as np
import torch
from live_view import (
    PATIENCE,
    center_of_box,
    drag,
    drawn,
    enter,
    pixels,
    place_of,
    pressures,
    set_slider,
    settled,
    share_of_bound,
    simulated,
    wait_for,
    wait_for_text,
)

import autdtorch as at
from autdtorch.objectives.objective import SimulatedObjective


def cube_of(explorer):
    return explorer.scene.obstacles[0]


def test_it_opens_with_a_good_drive_and_its_readings(live):
    explorer, page = live
    np.testing.assert_allclose(pressures(page), simulated(explorer), rtol=1e-2)  # three digits are shown
    assert share_of_bound(explorer) > 0.97
    assert np.ptp(pixels(page)) > 200  # a picture is there
    assert "cube and sphere" in page.title()


def test_a_move_during_a_search_begins_it_again(live, monkeypatch):
    explorer, page = live
    moved, measure = threading.Event(), SimulatedObjective.__call__
    monkeypatch.setattr(SimulatedObjective, "__call__", lambda *call: moved.wait(PATIENCE) and measure(*call))
    page.click("#in_phase")
    page.click("#find")
    set_slider(page, "body_y", 47.0)
    wait_for(lambda: abs(cube_of(explorer).center[1] - 47e-3) < 1e-9)
    moved.set()
    wait_for(lambda: not torch.equal(explorer.drive, torch.ones_like(explorer.drive)))
    explorer.ready()
    assert share_of_bound(explorer) > 0.97


def test_a_slider_breaks_the_foci_and_undo_mends_them(live):
    explorer, page = live
    before, picture = pressures(page), pixels(page)
    set_slider(page, "body_y", 52.0, let_go=False)
    wait_for_text(page, "summary", "Coarse, cells of 4.13 mm")  # while it is dragged: 0.24 wavelengths
    assert abs(cube_of(explorer).center[1] - 52e-3) < 1e-9
    set_slider(page, "body_y", 52.0)
    wait_for_text(page, "summary", "error")
    moved = pressures(page)
    np.testing.assert_allclose(moved, simulated(explorer), rtol=1e-2)
    assert moved.min() < 0.9 * before.min()
    wait_for(lambda: np.abs(pixels(page) - picture).max() > 100)
    with settled(page):
        page.click("#undo")
    assert np.array_equal(pressures(page), before)
    with settled(page):
        page.keyboard.press("Control+Shift+Z")
    assert np.array_equal(pressures(page), moved)


def test_numbers_and_the_keyboard_move_an_obstacle(live):
    explorer, page = live

    def is_at(height):
        return abs(cube_of(explorer).center[2] - height) < 1e-9

    page.fill("#body_z_number", "55.3")
    with settled(page):  # a result that arrives leaves a number that is being typed
        page.evaluate("window.trame.trigger('in_phase')")
    assert page.input_value("#body_z_number") == "55.3"
    with settled(page):
        page.press("#body_z_number", "Enter")
    assert is_at(55.3e-3)
    page.focus("#body_z")
    with settled(page):
        page.keyboard.press("ArrowLeft")
    assert is_at(55.2e-3)
    page.wait_for_selector("#undo:not([disabled])")
    page.keyboard.press("Control+z")
    wait_for(lambda: is_at(55.3e-3))


def test_an_obstacle_is_turned_by_sliders(live):
    explorer, page = live
    with settled(page):
        set_slider(page, "turn_z", 30)
    np.testing.assert_allclose(cube_of(explorer).rotation, (0, 0, np.pi / 6), atol=1e-6)
    np.testing.assert_allclose(pressures(page), simulated(explorer), rtol=1e-2)
    page.select_option("#body", label="1: sphere")
    page.wait_for_selector("#turn_z[disabled]")  # turning a sphere changes nothing


def test_an_obstacle_is_dragged_and_turned_in_the_picture(live):
    explorer, page = live
    start = center_of_box(page)
    before = cube_of(explorer)

    def step(obstacle):
        return np.subtract(cube_of(explorer).center, obstacle.center)

    with settled(page):
        drag(page, start, (40, 0), lambda: np.linalg.norm(step(before)) > 4e-3)
    aside = cube_of(explorer)
    assert aside.center[2] == before.center[2]  # as on a table
    assert aside.rotation == before.rotation
    with settled(page):
        start = place_of(explorer, page, aside.center)
        drag(page, start, (0, -60), lambda: step(aside)[2] > 5e-3, key="Control")
    lifted = cube_of(explorer)
    assert lifted.center[:2] == aside.center[:2]
    angles = (0, 0, np.radians(20))
    with settled(page):
        start = place_of(explorer, page, lifted.center)
        drag(
            page, start, (40, 0), lambda: np.allclose(cube_of(explorer).rotation, angles, atol=1e-6), "Shift"
        )
    np.testing.assert_allclose(cube_of(explorer).rotation, angles, atol=1e-6)
    assert cube_of(explorer).center == lifted.center


def test_mouse_and_buttons_move_the_camera_and_other_keys_do_not(live, scene):
    explorer, page = live
    box = page.locator(".view").bounding_box()
    corner = (box["x"] + 30, box["y"] + box["height"] - 30)

    first = drawn(explorer)

    def change():
        return np.abs(drawn(explorer) - first).mean()

    def has_moved():
        return change() > 2

    def goes_back():  # again, as a late event of the drag may come after the first click
        page.click("#look_first")
        return change() < 0.5

    drag(page, corner, (80, 40), has_moved)
    wait_for(goes_back)
    page.focus("#look_left")
    page.keyboard.press("Enter")
    wait_for(has_moved)
    page.mouse.click(*corner)
    for key in "3pws":  # of VTK: stereo, a box, wireframe
        page.keyboard.press(key)
    wait_for(goes_back)
    assert explorer.scene is scene


def test_foci_are_added_moved_and_removed(live):
    explorer, page = live
    with settled(page):
        page.click("#add_focus")
    assert len(explorer.scene.control_points) == 4
    with settled(page):
        set_slider(page, "focus_z", 30.0)
    assert abs(float(explorer.scene.control_points[3, 2]) - 30e-3) < 1e-9
    np.testing.assert_allclose(pressures(page), simulated(explorer), rtol=1e-2)
    page.click("#remove_focus")
    wait_for(lambda: len(explorer.scene.control_points) == 3)


def test_methods_find_phases_and_can_be_cancelled(live):
    explorer, page = live
    with settled(page):
        page.click("#in_phase")
    assert torch.equal(explorer.drive, torch.ones_like(explorer.drive))
    in_phase = pressures(page).min()
    page.select_option("#method", "gabs")
    with settled(page):
        page.click("#find")
    page.wait_for_selector("#find:not([disabled])")
    assert pressures(page).min() > 1.5 * in_phase
    drive = explorer.drive
    page.select_option("#method", "bayes_opt")  # takes a minute
    page.click("#find")
    page.wait_for_selector("#cancel:not([disabled])")
    page.mouse.click(*center_of_box(page))  # chooses it, and moves nothing
    page.select_option("#plane", "z")  # waits for the end of the method
    wait_for_text(page, "status", "evaluations")
    assert page.is_enabled("#cancel")
    page.click("#cancel")
    page.wait_for_selector("#find:not([disabled])")
    assert torch.equal(explorer.drive, drive)
    page.click("#undo")  # of the plane
    page.click("#undo")
    wait_for(lambda: torch.equal(explorer.drive, torch.ones_like(explorer.drive)))


def test_phases_follow_an_obstacle_and_undo_brings_them_back(live):
    explorer, page = live
    page.check("#follow")
    with settled(page):
        page.click("#in_phase")
    drive = explorer.drive
    assert torch.equal(drive, torch.ones_like(drive))  # what the user set stays until something moves
    with settled(page):
        set_slider(page, "body_y", 52.0)
    assert share_of_bound(explorer) > 0.97
    with settled(page):
        page.click("#undo")
    assert torch.equal(explorer.drive, drive)


def test_the_drive_is_edited(live):
    explorer, page = live
    before = explorer.drive
    enter(page, "transducer", 5)
    chosen = float(torch.rad2deg(at.phases_of(before)[5]))
    wait_for(lambda: abs(float(page.input_value("#phase_number")) - chosen) < 0.01)
    for name, value in (("phase", 90), ("amplitude", 0.5), ("amplitude", 0), ("amplitude", 0.5)):
        with settled(page):
            set_slider(page, name, value)
        assert page.input_value("#phase_number") == "90"  # also of a silent transducer
    assert abs(complex(explorer.drive[5]) - -0.5j) < 1e-6  # q = a e^{-i phi}
    others = [index for index in range(16) if index != 5]
    assert torch.equal(explorer.drive[others], before[others])
    np.testing.assert_allclose(pressures(page), simulated(explorer), rtol=1e-2)


def test_undo_brings_back_the_colours_of_the_field(live):
    _, page = live
    first = page.input_value("#reference")
    enter(page, "reference", 123)
    wait_for(lambda: "123 Pa" in page.inner_text(".legend span:nth-child(3)"))
    page.select_option("#method", "gs")
    with settled(page):
        page.click("#find")  # new colours for a new drive
    assert page.input_value("#reference") != "123"
    for expected in ("123", first):
        with settled(page):
            page.click("#undo")
        wait_for(lambda expected=expected: page.input_value("#reference") == expected)


def test_plane_unit_and_volume_change_the_picture(live):
    explorer, page = live
    seen = [drawn(explorer)]

    def is_another(picture):
        return picture.shape == seen[-1].shape and np.abs(picture - seen[-1]).mean() > 0.5

    def require_another_picture():
        wait_for(lambda: is_another(drawn(explorer)))
        seen.append(drawn(explorer))

    with settled(page):
        page.select_option("#plane", "z")
    require_another_picture()
    with settled(page):
        set_slider(page, "height", 30)
    require_another_picture()
    page.select_option("#unit", "Pa")
    require_another_picture()
    wait_for(lambda: page.inner_text(".legend span:first-child") == "0 Pa")
    enter(page, "reference", 100)
    require_another_picture()
    page.click("#rescale")
    page.check("#volume")
    require_another_picture()
    enter(page, "surface", 5)
    wait_for(lambda: page.input_value("#surface") == "-6")


def test_the_page_shows_what_a_program_sets_and_undoes_it(live, scene):
    explorer, page = live
    options = page.locator("#body option")
    before = options.all_text_contents()
    other = at.Cylinder((35e-3, 20e-3, 50e-3), 5e-3, 30e-3, rigid=True)
    with settled(page):
        explorer.scene = replace(scene, obstacles=(*scene.obstacles, other), name="three")
    wait_for(lambda: options.all_text_contents() == [*before, "2: cylinder"])
    wait_for(lambda: "three" in page.title())
    with settled(page):
        explorer.drive = torch.ones(16, dtype=torch.complex128)
    np.testing.assert_allclose(pressures(page), simulated(explorer), rtol=1e-2)
    page.click("#undo")
    with settled(page):
        page.click("#undo")
    assert explorer.scene is scene
    wait_for(lambda: options.all_text_contents() == before)
