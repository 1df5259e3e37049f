"""The live view: memory, and the time from a slider's move to the new field in a browser.

A headless Chromium on the same machine moves a slider; the time ends with the frame of the new field. Then
the obstacle is moved many times more, for the memory of the process. The picture of the page is taken, too.
Takes about four minutes on 2 idle cores.
"""

import gc
import itertools
import shutil
import statistics
from collections.abc import Iterator
from typing import Any

import psutil
from playwright.sync_api import sync_playwright
from shared.document import Page, table
from shared.scenes import paper_scene

import autdtorch as at

DOCUMENT = "explore.md"
OPTIONS = {
    "--scene": {"default": "two_cubes", "help": "scene of the paper"},
    "--moves": {"type": int, "default": 50, "help": "moves that are timed, dragged and let go"},
    "--more": {"type": int, "default": 500, "help": "moves while memory is watched"},
}

_WINDOW = {"width": 1280, "height": 900}  # pixels
_SWITCHES = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync"]
_AT_REST = 500  # ms between two moves, so that no calculation is left
_SOME = 50  # moves between two readings of the memory

# Resolves with the time [ms] until a frame came after the readings of the new field.
_MOVE = """([name, value, letGo]) => new Promise((resolve, reject) => {
    const section = document.querySelector('section.picture');
    const image = document.querySelector('.view img');
    const slider = document.getElementById(name);
    const before = Number(section.dataset.shown);
    const begun = performance.now();
    const watch = new MutationObserver(changes => {
        const isCoarse = document.getElementById('summary').textContent.includes('Coarse');
        const isNew = Number(section.dataset.shown) > before && (isCoarse !== letGo);
        if (isNew && changes.some(change => change.target === image)) {
            watch.disconnect();
            requestAnimationFrame(() => resolve(performance.now() - begun));
        }
    });
    watch.observe(section, {attributes: true, attributeFilter: ['data-shown']});
    watch.observe(image, {attributes: true, attributeFilter: ['src']});
    slider.value = value;
    slider.dispatchEvent(new Event('input', {bubbles: true}));
    if (letGo) slider.dispatchEvent(new Event('change', {bubbles: true}));
    setTimeout(() => reject(new Error('the view did not follow')), 20000);
})"""


def main(page: Page, scene: str, moves: int, more: int) -> None:
    """Measure and write the block."""
    explorer = at.explore(paper_scene(scene))
    program = shutil.which("chromium") or shutil.which("google-chrome")
    place = places()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=_SWITCHES)
        tab = browser.new_page(viewport=_WINDOW)
        tab.goto(explorer.address)
        tab.wait_for_selector("section.picture[aria-busy=false]")
        tab.get_by_text("Estimated error").wait_for()
        tab.screenshot(path=page.folder / "explore.png")
        times(tab, place, 3)  # what is done once
        seconds = times(tab, place, moves)
        megabytes = memory(tab, place, more)
        browser.close()
    explorer.close()
    rows = []
    for label, spent in zip(
        ("dragged, cells of 2 mm", "let go, cells of 1 mm"), seconds.values(), strict=True
    ):
        shares = statistics.quantiles(spent, n=20, method="inclusive")
        rows.append([label, f"{shares[9]:.2f} s", f"{shares[18]:.2f} s"])
    parts = [
        f"From a slider's move to the frame with the new field, `{scene}`, {moves} moves each:",
        table(("the slider is", "median", "95 % within"), rows),
        f"Memory of the process: {megabytes[0]:.0f} MB before {more} more moves, after every {_SOME} "
        f"{min(megabytes[1:]):.0f} to {max(megabytes[1:]):.0f} MB, {megabytes[-1]:.0f} MB at the end.",
    ]
    page.write(*parts)
    print("\n\n".join(parts))


def places() -> Iterator[str]:
    """Yield places of the obstacle [mm], in steps of the slider, each unlike the one before."""
    for step in itertools.count():
        yield f"{50.1 + 0.1 * (37 * step % 50):.1f}"


def times(tab: Any, place: Iterator[str], moves: int) -> dict[bool, list[float]]:
    """Return the times [s] of moves, by whether the slider was let go."""
    seconds: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(moves):
        for let_go, spent in seconds.items():
            tab.wait_for_timeout(_AT_REST)
            spent.append(1e-3 * tab.evaluate(_MOVE, ["body_y", next(place), let_go]))
    return seconds


def memory(tab: Any, place: Iterator[str], moves: int) -> list[float]:
    """Return the memory [MB] of this process, which is the server, at the beginning and after some moves."""
    process = psutil.Process()
    megabytes = [process.memory_info().rss / 1e6]
    for move in range(1, moves + 1):
        tab.evaluate(_MOVE, ["body_y", next(place), move % 5 == 0])
        if move % _SOME == 0:
            gc.collect()
            megabytes.append(process.memory_info().rss / 1e6)
    return megabytes
