"""The live view in a real browser: what a user does there changes scene, drive and picture."""

import contextlib
import io
import re
import time

import numpy as np
import pytest
import torch
from PIL import Image

import autdtorch as at
from autdtorch.plot.view3d import rendering_problem

pytest.importorskip("trame_rca", reason="trame: install autdtorch[explore]")

SPACING = 1.5e-3  # cells of the fine calculation here
PATIENCE = 30_000  # ms; the first simulation may compile kernels, and the machine may be busy


@pytest.fixture(scope="module")
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


@pytest.fixture(scope="module")
def unchanged(scene):
    """A live view that tests share, since they leave scene and drive as they are."""
    if problem := rendering_problem():
        pytest.skip(problem)
    explorer = at.explore(scene, spacing=SPACING)
    yield explorer
    explorer.close()


@contextlib.contextmanager
def opened(browser, explorer, width=1280, **options):
    """The page of a live view, when the first drive is found."""
    page = browser.new_page(viewport={"width": width, "height": 900}, **options)
    page.set_default_timeout(PATIENCE)
    page.goto(explorer.address)
    wait_for_first(page)
    yield page
    page.close()


def wait_for_first(page):
    """Wait for the first result, with its error."""
    page.wait_for_selector("section.picture[aria-busy=false]")
    page.wait_for_function("document.getElementById('summary').textContent.includes('error')")


@contextlib.contextmanager
def settled(page):
    """Wait for the result of what is done within, with its error."""
    before = page.get_attribute("section.picture", "data-shown")
    yield
    page.wait_for_function(
        """before => {
            const data = document.querySelector('section.picture');
            return data.dataset.shown > Number(before) && data.getAttribute('aria-busy') === 'false'
                && document.getElementById('summary').textContent.includes('error');
        }""",
        arg=before,
    )


def set_slider(page, name, value, let_go=True):
    """Move a slider as the mouse does, and let it go."""
    page.eval_on_selector(
        f"#{name}",
        """(slider, [value, letGo]) => {
            slider.value = value;
            slider.dispatchEvent(new Event('input', {bubbles: true}));
            if (letGo) slider.dispatchEvent(new Event('change', {bubbles: true}));
        }""",
        [str(value), let_go],
    )


def wait_for(condition, seconds=PATIENCE / 1000):
    """Wait until a function of the live view's state is true."""
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "the live view did not follow"
        time.sleep(0.05)


def pressures(page):
    """Pressures of the table of foci [Pa]."""
    cells = page.locator("table tbody tr td:nth-child(5)").all_text_contents()
    return np.array([float(cell) for cell in cells])


def pixels(page):
    """The picture as it is on the screen (height, width, 3)."""
    shot = page.locator(".view").screenshot()
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(float)


def simulated(explorer, spacing=SPACING):
    """Pressures at the foci [Pa] of what the live view holds, simulated here."""
    return (
        at.make_propagator(explorer.scene, spacing=spacing)
        .field(explorer.drive, explorer.scene.control_points)
        .abs()
        .numpy()
    )


def center_of_box(page):
    """A point of the window [pixels] where only the obstacle's grey is."""
    seen = pixels(page)
    grey = (np.ptp(seen, axis=-1) < 12) & (seen.mean(axis=-1) > 90) & (seen.mean(axis=-1) < 215)
    blocks = np.lib.stride_tricks.sliding_window_view(grey, (25, 25))[::5, ::5].mean(axis=(2, 3))
    row, column = np.unravel_index(blocks.argmax(), blocks.shape)
    assert blocks.max() > 0.9, "no obstacle is seen"
    box = page.locator(".view").bounding_box()
    return box["x"] + float(5 * column + 12), box["y"] + float(5 * row + 12)


def drag(page, start, offset, shift=False):
    """Drag by some pixels, in steps."""
    page.mouse.move(*start)
    if shift:
        page.keyboard.down("Shift")
    page.mouse.down()
    for share in (0.2, 0.4, 0.6, 0.8, 1.0):
        page.mouse.move(start[0] + share * offset[0], start[1] + share * offset[1])
        page.wait_for_timeout(60)  # the page sends at most one event in 30 ms
    page.mouse.up()
    if shift:
        page.keyboard.up("Shift")


def share_of_bound(explorer):
    """Weakest focus of what a live view holds, over the most that any drive reaches."""
    matrix = at.make_propagator(explorer.scene, spacing=SPACING).transfer_matrix()
    return float((matrix @ explorer.drive).abs().min()) / float(at.focus_bound(matrix))


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
        drag(page, start, (0, -60))
    moved = explorer.scene.obstacles[0]
    # The camera looks down a little, so that up on the screen is mostly up in space
    assert moved.center[2] - before.center[2] > 5e-3
    assert moved.rotation == before.rotation
    drag(page, (start[0], start[1] - 60), (40, 0), shift=True)
    wait_for(lambda: explorer.scene.obstacles[0].rotation != before.rotation)
    np.testing.assert_allclose(explorer.scene.obstacles[0].rotation, (0, 0, np.radians(20)), atol=1e-6)
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
    page.select_option("#transducer", "5")
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


def test_what_cannot_be_is_refused_and_said(live):
    explorer, page = live
    before = explorer.scene
    page.fill("#focus_x_number", "40")  # into the cube
    page.fill("#focus_y_number", "45")
    page.fill("#focus_z_number", "50")
    page.press("#focus_z_number", "Enter")
    page.wait_for_function("document.getElementById('message').textContent.includes('obstacle')")
    assert not any(one.contains(explorer.scene.control_points).any() for one in explorer.scene.obstacles)
    page.fill("#body_x_number", "")
    page.press("#body_x_number", "Enter")
    page.fill("#body_x_number", "1e9")
    page.press("#body_x_number", "Enter")
    page.wait_for_timeout(300)
    assert explorer.scene.obstacles == before.obstacles


def test_files_and_lines_of_python_make_what_is_shown(live, tmp_path, monkeypatch):
    explorer, page = live
    monkeypatch.chdir(tmp_path)
    set_slider(page, "turn_x", 25)
    wait_for(lambda: explorer.scene.obstacles[0].rotation != (0.0, 0.0, 0.0))
    page.fill("#folder", "here/there")
    page.click("#save")
    page.wait_for_function("document.getElementById('saved').textContent.includes('saved')")
    scene = at.load_scene("here/there/scene.yaml")
    assert scene.obstacles == explorer.scene.obstacles
    assert torch.equal(scene.control_points, explorer.scene.control_points)
    assert torch.equal(at.load_drive("here/there/drive.npz"), explorer.drive)
    page.click("#save")  # this folder is its own
    page.wait_for_function("document.getElementById('message').textContent === ''")
    page.click("#write_python")
    page.wait_for_function("document.getElementById('python').textContent.includes('at.Scene')")
    before = page.text_content("#python")
    with settled(page):
        set_slider(page, "body_x", 42)
    page.wait_for_function("old => document.getElementById('python').textContent !== old", arg=before)
    made = {}
    exec(page.text_content("#python"), made)
    assert made["scene"].obstacles == explorer.scene.obstacles
    torch.testing.assert_close(made["drive"], explorer.drive, rtol=0, atol=1e-12)


def test_folders_elsewhere_and_those_of_others_are_refused(unchanged, browser, tmp_path, monkeypatch):
    inside = tmp_path / "inside"
    inside.mkdir()
    mine = inside / "scene.yaml"
    mine.write_text("mine", "utf-8")
    monkeypatch.chdir(inside)
    with opened(browser, unchanged) as page:
        for folder in ("/tmp/elsewhere", "../elsewhere", "a/../../b", "", "."):
            page.fill("#folder", folder)
            page.click("#save")
            page.wait_for_function(
                "folder => document.getElementById('message').textContent.includes(`'${folder}'`)", arg=folder
            )
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
        }""",
        code,
    )
    page.wait_for_timeout(1000)
    assert not list(tmp_path.rglob("marker"))
    assert explorer.scene.obstacles[0].size == before.obstacles[0].size
    page.reload()
    page.uncheck("#follow")
    page.uncheck("#volume")
    wait_for_first(page)
    page.click("#in_phase")
    wait_for(lambda: torch.equal(explorer.drive, torch.ones_like(drive)))


def test_it_works_offline_and_without_errors(unchanged, browser):
    page = browser.new_page()
    page.set_default_timeout(PATIENCE)
    asked, errors = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(unchanged.address)
    wait_for_first(page)
    own = unchanged.address.removesuffix("index.html")
    assert [url for url in asked if not url.startswith((own, "data:", "blob:"))] == []
    assert errors == []
    page.close()


@pytest.mark.parametrize("colours", ["light", "dark"])
@pytest.mark.parametrize("width", [1200, 360])
def test_the_page_is_accessible(unchanged, browser, colours, width):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    with opened(browser, unchanged, width, color_scheme=colours) as page:
        found = axe.run(page)
        assert found.violations_count == 0, found.generate_report()
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        if colours == "dark":
            wait_for(lambda: np.median(pixels(page)) < 80)


def test_a_notebook_shows_a_frame_that_a_browser_fills(unchanged, browser):
    page = browser.new_page()
    page.set_default_timeout(PATIENCE)
    page.set_content(f"<h1>notebook</h1>{unchanged._repr_html_()}")
    frame = page.frame_locator("iframe")
    frame.locator("section.picture[aria-busy=false]").wait_for()
    assert re.search(r"Weakest focus \d", frame.locator("#summary").inner_text())
    page.close()
