"""The page of a live view in a browser: what tests of it share."""

import contextlib
import io
import time

import numpy as np
from PIL import Image

import autdtorch as at

SPACING = 1.5e-3  # cells of the fine calculation here
PATIENCE = 30_000  # ms; the first simulation may compile kernels, and the machine may be busy


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


def drag(page, start, offset, key=None):
    """Drag by some pixels, in steps, with a key held."""
    page.mouse.move(*start)
    if key:
        page.keyboard.down(key)
    page.mouse.down()
    for share in (0.2, 0.4, 0.6, 0.8, 1.0):
        page.mouse.move(start[0] + share * offset[0], start[1] + share * offset[1])
        page.wait_for_timeout(60)  # the page sends at most one event in 30 ms
    page.mouse.up()
    if key:
        page.keyboard.up(key)


def share_of_bound(explorer):
    """Weakest focus of what a live view holds, over the most that any drive reaches."""
    matrix = at.make_propagator(explorer.scene, spacing=SPACING).transfer_matrix()
    return float((matrix @ explorer.drive).abs().min()) / float(at.focus_bound(matrix))
