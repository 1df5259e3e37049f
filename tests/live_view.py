"""The page of a live view in a browser: what tests of it share. Each waits for a state, never for time."""

import contextlib
import io
import time

import numpy as np
from PIL import Image

import autdtorch as at

SPACING = 4e-3  # cells of the fine calculation here, at 20 kHz: a view of 6 wavelengths
PATIENCE = 120  # s; the first simulation may compile kernels, and the machine may be busy
IDLE = "document.querySelector('section.picture[aria-busy=false]') !== null"


@contextlib.contextmanager
def opened(browser, explorer, width=1280, **options):
    """The page of a live view, with a fine result."""
    page = new_page(browser, viewport={"width": width, "height": 900}, **options)
    try:
        page.goto(explorer.address)
        wait_for_fine(page)
        yield page
    finally:
        page.close()


def new_page(browser, **options):
    page = browser.new_page(**options)
    page.set_default_timeout(1000 * PATIENCE)
    return page


def wait_for_fine(page):
    """Wait for a result with its error, while no other is asked for."""
    wait_for_text(page, "summary", "error", IDLE)


def wait_for_text(page, element, text, also="true"):
    condition = f"([name, text]) => document.getElementById(name)?.textContent.includes(text) && {also}"
    wait_in_page(page, condition, [element, text])


def wait_in_page(page, condition, argument):
    """Wait for a condition, by the clock: a page that is not drawn has no frames. Failures show it."""
    try:
        page.wait_for_function(condition, arg=argument, polling=100)
    except Exception as error:
        picture = page.locator("section.picture").first.evaluate("element => element.outerHTML.slice(0, 300)")
        error.add_note(f"{picture}\n{page.inner_text('body')}")
        raise


@contextlib.contextmanager
def settled(page):
    """Wait for the fine result of what is done within."""
    wait_for_fine(page)
    before = page.get_attribute("section.picture", "data-shown")
    yield
    wait_in_page(page, "old => document.querySelector('section.picture').dataset.shown > Number(old)", before)
    wait_for_fine(page)


def enter(page, name, value):
    """Enter a number or a text as the keyboard does."""
    page.fill(f"#{name}", str(value))
    page.press(f"#{name}", "Enter")


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


def wait_for(condition, seconds=PATIENCE):
    """Wait until a function of the live view's state is true."""
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "the live view did not follow"
        time.sleep(0.05)


def in_session(explorer, act):
    """Call a function of the session in its thread."""
    explorer._server.call(lambda: act(explorer._application.session))


def pressures(page):
    """Pressures of the table of foci [Pa]."""
    cells = page.locator("table tbody tr td:nth-child(5)").all_text_contents()
    return np.array([float(cell) for cell in cells])


def pixels(page):
    """The picture as it is on the screen (height, width, 3)."""
    shot = page.locator(".view").screenshot()
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(float)


def drawn(explorer):
    """The picture as the server has it (height, width, 3); its frames come to the page later."""
    shots = []
    in_session(explorer, lambda session: shots.append(session.display.picture.plotter.screenshot()))
    return np.asarray(shots[0]).astype(float)


def still(page):
    """The picture once two in a row are equal: a frame of lower quality comes first."""
    frames = [pixels(page)]

    def rests():
        frames.append(pixels(page))
        return np.array_equal(*frames[-2:])

    wait_for(rests)
    return frames[-1]


def simulated(explorer):
    """Pressures at the foci [Pa] of scene and drive of the live view, simulated here."""
    propagator = at.make_propagator(explorer.scene, spacing=SPACING)
    return propagator.field(explorer.drive, explorer.scene.control_points).abs().numpy()


def share_of_bound(explorer):
    """Weakest focus of a live view, over the most that any drive reaches."""
    matrix = at.make_propagator(explorer.scene, spacing=SPACING).transfer_matrix()
    return float((matrix @ explorer.drive).abs().min()) / float(at.focus_bound(matrix))


def center_of_box(page):
    """A point of the window [pixels] where only the obstacle's grey is, once it is drawn."""
    blocks = np.zeros((1, 1))

    def is_drawn():
        nonlocal blocks
        seen = still(page)
        grey = (np.ptp(seen, axis=-1) < 12) & (seen.mean(axis=-1) > 90) & (seen.mean(axis=-1) < 215)
        blocks = np.lib.stride_tricks.sliding_window_view(grey, (25, 25))[::5, ::5].mean(axis=(2, 3))
        return blocks.max() > 0.9

    wait_for(is_drawn)
    row, column = np.unravel_index(blocks.argmax(), blocks.shape)
    box = page.locator(".view").bounding_box()
    return box["x"] + float(5 * column + 12), box["y"] + float(5 * row + 12)


def place_of(explorer, page, point):
    """The point of the window [pixels] where a point [m] of the scene is drawn."""
    shares = []

    def project(session):
        renderer = session.display.picture.plotter.renderer
        renderer.SetWorldPoint(*(1e3 * np.array(point)), 1.0)
        renderer.WorldToDisplay()
        width, height = renderer.GetRenderWindow().GetSize()
        x, y, _ = renderer.GetDisplayPoint()
        shares.extend((x / width, 1 - y / height))

    in_session(explorer, project)
    box = page.locator(".view").bounding_box()
    return box["x"] + shares[0] * box["width"], box["y"] + shares[1] * box["height"]


def drag(page, start, offset, arrived, key=None):
    """Drag by some pixels with a key held, until a function of the live view's state is true; let go then."""
    page.mouse.move(*start)
    if key:
        page.keyboard.down(key)
    page.mouse.down()

    def move():  # again, as the page sends one event in 30 ms and leaves out others
        for share in (0.5, 1.0):
            page.mouse.move(start[0] + share * offset[0], start[1] + share * offset[1])
            page.wait_for_timeout(60)
        return arrived()

    wait_for(move)
    page.mouse.up()
    if key:
        page.keyboard.up(key)
