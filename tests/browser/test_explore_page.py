"""The page of the live view: what it refuses, writes and loads, and who can use it."""

import re

import numpy as np
import pytest
import torch
from live_view import (
    enter,
    new_page,
    opened,
    pixels,
    set_slider,
    settled,
    wait_for,
    wait_for_fine,
    wait_for_text,
)

import autdtorch as at


def test_what_cannot_be_is_refused_and_said(live):
    explorer, page = live
    before = explorer.scene
    page.fill("#focus_x_number", "40")  # into the cube
    page.fill("#focus_y_number", "45")
    enter(page, "focus_z_number", 50)
    wait_for_text(page, "message", "obstacle")
    assert not any(body.contains(explorer.scene.control_points).any() for body in explorer.scene.obstacles)
    for wrong in ("", "1e9"):
        enter(page, "body_x_number", wrong)
        wait_for(lambda: page.input_value("#body_x_number") == "40")  # is set back
    assert explorer.scene.obstacles == before.obstacles


def test_files_and_lines_of_python_make_what_is_shown(live, tmp_path, monkeypatch):
    explorer, page = live
    monkeypatch.chdir(tmp_path)
    with settled(page):
        set_slider(page, "turn_x", 25)
    page.fill("#folder", "here/there")
    page.click("#save")
    wait_for_text(page, "saved", "saved")
    scene = at.load_scene("here/there/scene.yaml")
    assert scene.obstacles == explorer.scene.obstacles
    assert torch.equal(scene.control_points, explorer.scene.control_points)
    assert torch.equal(at.load_drive("here/there/drive.npz"), explorer.drive)
    page.click("#save")  # this folder is its own
    page.wait_for_function("document.getElementById('message').textContent === ''")
    page.click("#write_python")
    wait_for_text(page, "python", "at.Scene")
    before = page.text_content("#python")
    with settled(page):
        set_slider(page, "body_x", 42)
    page.wait_for_function("old => document.getElementById('python').textContent !== old", arg=before)
    made = {}
    exec(page.text_content("#python"), made)
    assert made["scene"].obstacles == explorer.scene.obstacles
    torch.testing.assert_close(made["drive"], explorer.drive, rtol=0, atol=1e-12)


def test_folders_elsewhere_and_those_of_others_are_refused(live, tmp_path, monkeypatch):
    _, page = live
    inside = tmp_path / "inside"
    inside.mkdir()
    mine = inside / "scene.yaml"
    mine.write_text("mine", "utf-8")
    monkeypatch.chdir(inside)
    for folder in ("/tmp/elsewhere", "../elsewhere", "a/../../b", "", "."):
        page.fill("#folder", folder)
        page.click("#save")
        wait_for_text(page, "message", f"'{folder}'")
    assert sorted(tmp_path.rglob("*")) == [inside, mine]
    assert mine.read_text("utf-8") == "mine"


def test_what_a_page_sends_is_not_run(live, tmp_path, monkeypatch):
    """Values of any kind in any place leave the server as it was, and it goes on."""
    explorer, page = live
    monkeypatch.chdir(tmp_path)
    before, drive = explorer.scene, explorer.drive
    code = "__import__('pathlib').Path('marker').touch()"
    page.evaluate(
        """code => {
            const bad = [code, {__class__: code}, [[[]]], null, Infinity, -1, 1e9, 'x'.repeat(10000), true];
            const names = ['body_x', 'turn_y', 'focus_y', 'phase', 'amplitude', 'plane', 'height', 'method',
                'transducer', 'body', 'focus', 'device', 'settled', 'unit', 'reference', 'surface', 'dark',
                'follow', 'volume', 'rows'];
            for (const value of bad) for (const name of names) window.trame.state.set(name, value);
            for (const action of [code, 'os.system', '__class__', 'find', 'save', 'settle', 'close'])
                for (const given of [[], [code]]) window.trame.trigger(action, given).catch(() => {});
            window.trame.state.set('folder', 'the last of all');
        }""",
        code,
    )
    wait_for(lambda: explorer._application.session._state.folder == "the last of all")
    assert not list(tmp_path.rglob("marker"))
    assert explorer.scene.obstacles[0].size == before.obstacles[0].size
    page.reload()
    page.uncheck("#follow")
    page.uncheck("#volume")
    wait_for_fine(page)
    page.click("#in_phase")
    wait_for(lambda: torch.equal(explorer.drive, torch.ones_like(drive)))


def test_it_works_offline_and_without_errors(view, browser):
    page = new_page(browser)
    asked, errors = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(view.address)
    wait_for_fine(page)
    host = view.address.removesuffix("index.html")
    assert [url for url in asked if not url.startswith((host, "data:", "blob:"))] == []
    assert errors == []
    page.close()


@pytest.mark.parametrize("colours", ["light", "dark"])
def test_the_page_is_accessible(view, browser, colours):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    with opened(browser, view, color_scheme=colours) as page:
        for width in (1200, 360):
            page.set_viewport_size({"width": width, "height": 900})
            results = axe.run(page)
            assert results.violations_count == 0, results.generate_report()
            assert page.evaluate("document.documentElement.scrollWidth") <= width
        if colours == "dark":
            wait_for(lambda: np.median(pixels(page)) < 80)


def test_a_notebook_shows_a_frame_that_a_browser_fills(view, browser):
    page = new_page(browser)
    page.set_content(f"<h1>notebook</h1>{view._repr_html_()}")
    frame = page.frame_locator("iframe")
    frame.locator("section.picture[aria-busy=false]").wait_for()
    assert re.search(r"Weakest focus \d", frame.locator("#summary").inner_text())
    page.close()
