"""The live view in a real browser: what a user does there changes scene, drive and picture."""

import numpy as np
import pytest
import torch
from live_view import (
    PATIENCE,
    SPACING,
    center_of_box,
    drag,
    opened,
    pixels,
    pressures,
    set_slider,
    settled,
    share_of_bound,
    simulated,
    wait_for,
)

import autdtorch as at

pytest.importorskip("trame_rca", reason="trame: install autdtorch[explore]")


def test_it_opens_with_a_good_drive_and_its_readings(unchanged, browser):
    with opened(browser, unchanged) as page:
        np.testing.assert_allclose(pressures(page), simulated(unchanged), rtol=1e-2)  # three digits are shown
        assert share_of_bound(unchanged) > 0.97
        assert np.ptp(pixels(page)) > 200  # a picture is there
        assert "cube and sphere" in page.title()


def test_who_moves_at_once_finds_the_first_drive_too(scene, browser):
    explorer = at.explore(scene, spacing=SPACING)
    page = browser.new_page()
    page.set_default_timeout(PATIENCE)
    page.goto(explorer.address)
    page.wait_for_selector("#body_y")
    set_slider(page, "body_y", 47.0)
    wait_for(lambda: abs(explorer.scene.obstacles[0].center[1] - 47e-3) < 1e-9)
    page.wait_for_selector("section.picture[aria-busy=false]")
    wait_for(lambda: share_of_bound(explorer) > 0.97)
    page.close()
    explorer.close()


def test_a_slider_breaks_the_foci_and_undo_mends_them(live):
    explorer, page = live
    before, picture = pressures(page), pixels(page)
    set_slider(page, "body_y", 52.0, let_go=False)
    # Coarse while it is dragged: 0.24 wavelengths
    page.wait_for_function(
        "document.getElementById('summary').textContent.includes('Coarse, cells of 2.06 mm')"
    )
    assert abs(explorer.scene.obstacles[0].center[1] - 52e-3) < 1e-9
    with settled(page):
        set_slider(page, "body_y", 52.0)
    moved = pressures(page)
    np.testing.assert_allclose(moved, simulated(explorer), rtol=1e-2)
    assert moved.min() < 0.8 * before.min()
    assert np.abs(pixels(page) - picture).max() > 100
    with settled(page):
        page.click("#undo")
    assert np.array_equal(pressures(page), before)
    with settled(page):
        page.keyboard.press("Control+Shift+Z")
    assert np.array_equal(pressures(page), moved)


def test_numbers_and_the_keyboard_move_an_obstacle(live):
    explorer, page = live
    page.fill("#body_z_number", "55.3")
    page.press("#body_z_number", "Enter")
    wait_for(lambda: abs(explorer.scene.obstacles[0].center[2] - 55.3e-3) < 1e-9)
    page.focus("#body_z")
    page.keyboard.press("ArrowLeft")
    wait_for(lambda: abs(explorer.scene.obstacles[0].center[2] - 55.2e-3) < 1e-9)
    page.keyboard.press("Control+z")
    wait_for(lambda: abs(explorer.scene.obstacles[0].center[2] - 55.3e-3) < 1e-9)


def test_a_result_that_arrives_leaves_a_number_that_is_being_typed(live):
    explorer, page = live
    page.fill("#body_z_number", "55.3")
    with settled(page):
        page.evaluate("window.trame.trigger('in_phase')")
    assert page.input_value("#body_z_number") == "55.3"
    page.press("#body_z_number", "Enter")
    wait_for(lambda: abs(explorer.scene.obstacles[0].center[2] - 55.3e-3) < 1e-9)


def test_an_obstacle_is_turned_by_sliders(live):
    explorer, page = live
    with settled(page):
        set_slider(page, "turn_z", 30)
    np.testing.assert_allclose(explorer.scene.obstacles[0].rotation, (0, 0, np.pi / 6), atol=1e-6)
    np.testing.assert_allclose(pressures(page), simulated(explorer), rtol=1e-2)
    page.select_option("#body", label="1: sphere")
    page.wait_for_selector("#turn_z[disabled]")  # turning a sphere changes nothing


def test_an_obstacle_is_dragged_and_turned_in_the_picture(live):
    explorer, page = live
    start = center_of_box(page)
    before = explorer.scene.obstacles[0]
    with settled(page):
        drag(page, start, (40, 0))
    aside = explorer.scene.obstacles[0]
    assert np.linalg.norm(np.subtract(aside.center, before.center)) > 4e-3
    assert aside.center[2] == before.center[2]  # as on a table
    assert aside.rotation == before.rotation
    with settled(page):
        drag(page, (start[0] + 40, start[1]), (0, -60), key="Control")
    moved = explorer.scene.obstacles[0]
    assert moved.center[2] - aside.center[2] > 5e-3
    assert moved.center[:2] == aside.center[:2]
    drag(page, (start[0] + 40, start[1] - 60), (40, 0), key="Shift")
    wait_for(lambda: np.allclose(explorer.scene.obstacles[0].rotation, (0, 0, np.radians(20)), atol=1e-6))
    assert explorer.scene.obstacles[0].center == moved.center


def test_mouse_and_buttons_move_the_camera_and_other_keys_do_not(unchanged, browser):
    scene = unchanged.scene
    with opened(browser, unchanged) as page:
        box = page.locator(".view").bounding_box()
        corner = (box["x"] + 30, box["y"] + box["height"] - 30)
        page.click("#look_first")
        page.wait_for_timeout(500)
        before = pixels(page)

        def change():
            return np.abs(pixels(page) - before)[10:-10, 10:-10].mean()  # the rim shows what has the focus

        drag(page, corner, (80, 40))
        wait_for(lambda: change() > 2)
        page.click("#look_first")
        wait_for(lambda: change() < 0.5)
        page.focus("#look_left")
        page.keyboard.press("Enter")
        wait_for(lambda: change() > 2)
        page.click("#look_first")
        wait_for(lambda: change() < 0.5)
        page.mouse.click(*corner)
        for key in "3pws":  # of VTK: stereo, a box, wireframe
            page.keyboard.press(key)
        page.wait_for_timeout(300)
        wait_for(lambda: change() < 0.5)  # a frame of lower quality comes first
    assert unchanged.scene is scene


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
        page.wait_for_function("document.getElementById('status').textContent.includes('GABS')")
    page.wait_for_selector("#find:not([disabled])")
    assert pressures(page).min() > 1.5 * in_phase
    found = explorer.drive
    page.select_option("#method", "bayes_opt")  # takes a minute
    page.click("#find")
    page.wait_for_selector("#cancel:not([disabled])")
    page.mouse.click(*center_of_box(page))  # chooses it, and moves nothing
    page.select_option("#plane", "z")  # waits for the end of the method
    page.wait_for_function("document.getElementById('status').textContent.includes('evaluations')")
    assert page.is_enabled("#cancel")
    page.click("#cancel")
    page.wait_for_selector("#find:not([disabled])")
    assert torch.equal(explorer.drive, found)
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
    page.fill("#transducer", "5")
    page.press("#transducer", "Enter")
    chosen = float(torch.rad2deg(at.phases_of(before)[5]))
    wait_for(lambda: abs(float(page.input_value("#phase_number")) - chosen) < 0.01)
    with settled(page):
        set_slider(page, "phase", 90)
    with settled(page):
        set_slider(page, "amplitude", 0.5)
    assert abs(complex(explorer.drive[5]) - -0.5j) < 1e-6  # q = a e^{-i phi}
    with settled(page):
        set_slider(page, "amplitude", 0)
    assert page.input_value("#phase_number") == "90"
    with settled(page):
        set_slider(page, "amplitude", 0.5)
    assert abs(complex(explorer.drive[5]) - -0.5j) < 1e-6
    others = [index for index in range(16) if index != 5]
    assert torch.equal(explorer.drive[others], before[others])
    np.testing.assert_allclose(pressures(page), simulated(explorer), rtol=1e-2)


def test_undo_brings_back_the_colours_of_the_field(live):
    _, page = live
    first = page.input_value("#reference")
    page.fill("#reference", "123")
    page.press("#reference", "Enter")
    wait_for(lambda: "123 Pa" in page.inner_text(".legend span:nth-child(3)"))
    page.select_option("#method", "gs")
    with settled(page):
        page.click("#find")  # new colours for a new drive
    assert page.input_value("#reference") != "123"
    for expected in ("123", first):
        with settled(page):
            page.click("#undo")
        assert page.input_value("#reference") == expected


def test_plane_unit_and_volume_change_the_picture(live):
    _, page = live
    seen = [pixels(page)]

    def require_another_picture():
        wait_for(lambda: np.abs(pixels(page) - seen[-1]).mean() > 0.5)
        seen.append(pixels(page))

    with settled(page):
        page.select_option("#plane", "z")
    require_another_picture()
    with settled(page):
        set_slider(page, "height", 30)
    require_another_picture()
    page.select_option("#unit", "Pa")
    require_another_picture()
    assert page.inner_text(".legend span:first-child") == "0 Pa"
    page.fill("#reference", "100")
    page.press("#reference", "Enter")
    require_another_picture()
    page.click("#rescale")
    page.check("#volume")
    require_another_picture()
    page.fill("#surface", "5")
    page.press("#surface", "Enter")
    wait_for(lambda: page.input_value("#surface") == "-6")
