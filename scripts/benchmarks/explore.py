"""The live view: time from a slider's move to the new field on the screen, in a browser, and memory.

Fills in a block of explore.md. A headless Chromium on the same machine moves a slider; the time ends with the
frame of the new field. Then the obstacle is moved many times more, for the memory of the process.

    python scripts/benchmark.py explore         about four minutes on 2 idle cores
"""

from __future__ import annotations

import argparse
import gc
import itertools
import shutil
import statistics
from collections.abc import Iterator
from typing import Any

import psutil
from playwright.sync_api import sync_playwright
from shared.document import fill_in, measured, table
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
_SOME = 50  # Moves between two readings of the memory

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


def places() -> Iterator[str]:
    """Yield places of the obstacle [mm], in steps of the slider, each unlike the one before."""
    for step in itertools.count():
        yield f"{50.1 + 0.1 * (37 * step % 50):.1f}"


def times(page: Any, place: Iterator[str], moves: int) -> dict[bool, list[float]]:
    """Return the times [s] of moves, by whether the slider was let go."""
    found: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(moves):
        for let_go, spent in found.items():
            page.wait_for_timeout(_AT_REST)
            spent.append(1e-3 * page.evaluate(_MOVE, ["body_y", next(place), let_go]))
    return found


def memory(page: Any, place: Iterator[str], moves: int) -> list[float]:
    """Return the memory [MB] of this process, which is the server, at the beginning and after some moves."""
    process = psutil.Process()
    found = [process.memory_info().rss / 1e6]
    for move in range(1, moves + 1):
        page.evaluate(_MOVE, ["body_y", next(place), move % 5 == 0])
        if move % _SOME == 0:
            gc.collect()
            found.append(process.memory_info().rss / 1e6)
    return found


def main(given: argparse.Namespace) -> None:
    """Measure and write the block."""
    explorer = at.explore(paper_scene(given.scene))
    program = shutil.which("chromium") or shutil.which("google-chrome")
    place = places()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=_SWITCHES)
        page = browser.new_page(viewport=_WINDOW)
        page.goto(explorer.address)
        page.wait_for_selector("section.picture[aria-busy=false]")
        times(page, place, 3)  # what is done once
        spent = times(page, place, given.moves)
        held = memory(page, place, given.more)
        browser.close()
    explorer.close()
    names = {False: "dragged, cells of 2 mm", True: "let go, cells of 1 mm"}
    rows = [
        [names[let_go], *(f"{value:.2f} s" for value in (statistics.median(own), _percentile(own, 95)))]
        for let_go, own in spent.items()
    ]
    parts = [
        measured(),
        f"From a slider's move to the frame with the new field, `{given.scene}`, {given.moves} moves each:",
        table(("the slider is", "median", "95 % within"), rows),
        f"Memory of the process: {held[0]:.0f} MB before {given.more} more moves, after every {_SOME} "
        f"{min(held[1:]):.0f} to {max(held[1:]):.0f} MB, {held[-1]:.0f} MB at the end.",
    ]
    fill_in(DOCUMENT, "benchmark.py explore", parts, given.output)
    print("\n\n".join(parts))


def _percentile(values: list[float], share: float) -> float:
    return statistics.quantiles(values, n=100, method="inclusive")[round(share) - 1]
