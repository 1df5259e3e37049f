"""The live view: the time from a slider's move to the new field in a browser.

A headless Chromium on the same machine moves a slider; the time ends with the frame of the new field, or with
its error. The scenes are the paper's two cubes, and an AUTD3 of discs below a tilted phone. The picture of
the page is taken, too. Takes about six minutes on 2 idle cores.
"""

import itertools
import shutil
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright
from shared.document import DOCS, table
from shared.scenes import paper_scene

import autdtorch as at

OPTIONS = {
    "--moves": {"type": int, "default": 25, "help": "moves that are timed, dragged and let go"},
    "--picture": {"type": Path, "default": DOCS / "explore.png", "help": "of the page"},
}

_WINDOW = {"width": 1280, "height": 900}  # pixels
_SWITCHES = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync"]
_AT_REST = 500  # ms between two moves, so that no calculation is left
_LONGEST = 120_000  # ms until the first field

# Resolves with the times [ms] until a frame came after the readings of the new field, and until its error.
_MOVE = """([name, value, letGo]) => new Promise((resolve, reject) => {
    const section = document.querySelector('section.picture');
    const image = document.querySelector('.view img');
    const summary = document.getElementById('summary');
    const slider = document.getElementById(name);
    const before = Number(section.dataset.shown);
    const begun = performance.now();
    let frame = 0;
    const watch = new MutationObserver(changes => {
        const isCoarse = summary.textContent.includes('Coarse');
        if (Number(section.dataset.shown) <= before || isCoarse === letGo) return;
        if (!frame && changes.some(change => change.target === image)) frame = performance.now() - begun;
        if (!frame || letGo && !summary.textContent.includes('error')) return;
        watch.disconnect();
        requestAnimationFrame(() => resolve([frame, performance.now() - begun]));
    });
    watch.observe(section, {attributes: true, attributeFilter: ['data-shown']});
    watch.observe(image, {attributes: true, attributeFilter: ['src']});
    watch.observe(summary, {childList: true, characterData: true, subtree: true});
    slider.value = value;
    slider.dispatchEvent(new Event('input', {bubbles: true}));
    if (letGo) slider.dispatchEvent(new Event('change', {bubbles: true}));
    setTimeout(() => reject(new Error('the view did not follow')), 60000);
})"""


def main(picture: Path, moves: int) -> None:
    """Take the picture of the page, and print times."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    rows = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=_SWITCHES)
        for label, scene in (("AUTD3 and phone", phone_scene()), ("two cubes", paper_scene("two_cubes"))):
            explorer = at.explore(scene)
            tab = browser.new_page(viewport=_WINDOW)
            tab.set_default_timeout(_LONGEST)
            tab.goto(explorer.address)
            tab.wait_for_selector("section.picture[aria-busy=false]")
            tab.get_by_text("Estimated error").wait_for()
            if scene.name == "phone":
                tab.evaluate("document.querySelector('.view img').decode()")
                tab.screenshot(path=picture)
            place = places(1e3 * explorer.scene.obstacles[0].center[1])
            times(tab, place, 3)  # what is done once
            rows += [[label, kind, *row_of(spent)] for kind, spent in times(tab, place, moves).items()]
            tab.close()
            explorer.close()
        browser.close()
    print(f"From a slider's move to the frame with the new field, {moves} moves each:", end="\n\n")
    print(table(("scene", "the slider is", "median", "95 % within"), rows))


def phone_scene() -> at.Scene:
    """Return an AUTD3 of discs with a phone above it, tilted, and three foci behind the phone."""
    phone = at.Box((0, 0, 80e-3), (150e-3, 75e-3, 8e-3), rotation_degrees=(0, 20, 0), rigid=True)
    above = (0, 0, 150e-3)
    foci = at.circle_points(above, 25e-3, 3, (0, 0, 1))
    plane = at.Plane(above, (0, 0, 1), (200e-3, 160e-3))
    array = at.TransducerArray.autd3((0, 0, 0), normal=(0, 0, 1))
    return at.Scene(array, at.Medium.air(), 40e3, foci, (phone,), plane, name="phone")


def places(middle: float) -> Iterator[str]:
    """Yield places of the obstacle around one [mm], in steps of the slider, each unlike the one before."""
    for step in itertools.count():
        yield f"{middle + 0.1 + 0.1 * (37 * step % 50):.1f}"


def row_of(spent: list[float]) -> list[str]:
    shares = statistics.quantiles(spent, n=20, method="inclusive")
    return [f"{shares[9]:.2f} s", f"{shares[18]:.2f} s"]


def times(tab: Any, place: Iterator[str], moves: int) -> dict[str, list[float]]:
    """Return the times [s] of moves by a slider that is dragged, or let go."""
    kinds = dragged, let_go, known = "dragged", "let go", "let go, until the error is known"
    seconds: dict[str, list[float]] = {kind: [] for kind in kinds}
    for _ in range(moves):
        for shown in ((dragged,), (let_go, known)):
            tab.wait_for_timeout(_AT_REST)
            spent = tab.evaluate(_MOVE, ["body_y", next(place), let_go in shown])
            for kind, milliseconds in zip(shown, spent, strict=False):
                seconds[kind].append(1e-3 * milliseconds)
    return seconds
