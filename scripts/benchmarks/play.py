"""Foci that move behind obstacles: level, ripple and share of the bound, and frames a second.

A focus on a circle of 5 mm, 10 laps a second, 1000 frames/s, behind a tilted phone and behind the paper's
cubes, by an AUTD3 of discs: drives that know the obstacle, also as the AUTD3 plays them, and drives that do
not. Then two foci 10 mm apart in free space with a limit to phase steps. Takes about two minutes of a core.
"""

import dataclasses
import math
import time
from collections.abc import Iterator

import torch
from shared.document import Page, percent, printed, table
from shared.scenes import MIDDLE, paper_scene, weakest

import autdtorch as at

DOCUMENT = "play.md"

AIR = at.Medium(density=1.204, sound_speed=343.0)
RADIUS, FRAMES, LAPS = 5e-3, 100, 10.0
PAIR_FRAMES, PHASE_STEP, APART = 200, 0.8, 10e-3


def main(page: Page) -> None:
    page.write(
        "One focus on a circle of 5 mm, 10 laps a second, 1000 frames/s. Share: the least, over frames, of "
        "the highest pressure that the frame could have (`focus_bound`). Frames/s: of a core.",
        table(["behind", "drives", "pressure [Pa]", "ripple", "share", "frames/s"], printed(circles())),
        f"Two foci {1e3 * APART:g} mm apart on a circle of {PAIR_FRAMES} frames, phase_step={PHASE_STEP:g}, "
        "in free space: the even level over the bound of the weakest frame; without `even`, shares of each "
        "frame's bound:",
        table(["radius", "even level", "least share", "mean share", "frames/s"], printed(pairs())),
    )


def scenes() -> Iterator[at.Scene]:
    """Yield a phone and the paper's cubes before an AUTD3, with the circle as control points."""
    phone = at.Box((0.0, 0.0, 80e-3), (150e-3, 75e-3, 8e-3), rigid=True, rotation=(0.2, 0.3, 0.1))
    circle = at.circle_points((0.0, 0.0, 150e-3), RADIUS, FRAMES, (0.0, 0.0, 1.0))
    array = at.TransducerArray.autd3((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    yield at.Scene(array, AIR, 40e3, circle, obstacles=[phone], name="tilted phone")
    yield dataclasses.replace(
        paper_scene("two_cubes"),
        name="two cubes",
        array=at.TransducerArray.autd3(MIDDLE, (1.0, 0.0, 0.0)),
        control_points=at.circle_points((80e-3, 50e-3, 50e-3), RADIUS, FRAMES, (1.0, 0.0, 0.0)),
        domain=None,
        observation_plane=None,
    )


def circles() -> Iterator[list[str]]:
    for scene in scenes():
        matrix = at.make_propagator(scene, cache=False, tolerance=1e-2).transfer_matrix()[:, None]
        alone = dataclasses.replace(scene, obstacles=())
        free = at.make_propagator(alone).transfer_matrix()[:, None]
        bounds = torch.tensor([at.focus_bound(frame) for frame in matrix])
        for name, known in (("of one level", matrix), ("of free space", free)):
            drives, rate = solved(known, math.pi)
            yield row(scene.name, name, matrix, drives, bounds, f"{rate:,.0f}")
            if name == "of one level":
                levels = at.hardware.AUTD3.quantised(drives)
                played = at.silenced(at.Sequence(levels, FRAMES * LAPS)).drives
                parts = len(played) // FRAMES
                whole = matrix.repeat_interleave(parts, 0), played, bounds.repeat_interleave(parts)
                yield row(scene.name, "in levels, silenced", *whole, "")


def solved(matrix: torch.Tensor, phase_step: float, even: bool = True) -> tuple[torch.Tensor, float]:
    """Return the drives of a closed path, and the frames in a second of one core's time."""
    at.drive_sequence(matrix, phase_step=phase_step, closed=True, even=even)
    begin = time.process_time()
    drives = at.drive_sequence(matrix, phase_step=phase_step, closed=True, even=even)
    return drives, len(matrix) / (time.process_time() - begin)


def row(
    scene: str, name: str, matrix: torch.Tensor, drives: torch.Tensor, bounds: torch.Tensor, rate: str
) -> list[str]:
    pressure = weakest(matrix, drives)
    most, least = float(pressure.max()), float(pressure.min())
    ripple = (most - least) / (most + least)
    levels = f"{least:.0f} to {most:.0f}"
    return [scene, name, levels, f"{100 * ripple:.1f} %", percent(float((pressure / bounds).min())), rate]


def pairs() -> Iterator[list[str]]:
    array = at.TransducerArray.autd3((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    for radius in (5e-3, 30e-3):
        angles = 0.0, 2 * math.asin(APART / 2 / radius)
        circle = [
            at.circle_points((0.0, 0.0, 150e-3), radius, PAIR_FRAMES, (0.0, 0.0, 1.0), angle)
            for angle in angles
        ]
        places = torch.stack(circle, dim=1)
        propagator = at.make_propagator(at.Scene(array, AIR, 40e3, places[0]))
        matrix = propagator.transfer_matrix(places.reshape(-1, 3)).reshape(PAIR_FRAMES, 2, -1)
        bounds = torch.tensor([at.focus_bound(frame) for frame in matrix])
        drives, rate = solved(matrix, PHASE_STEP)
        level = weakest(matrix, drives).min() / bounds.min()
        share = weakest(matrix, solved(matrix, PHASE_STEP, even=False)[0]) / bounds
        shares = percent(float(level)), percent(float(share.min())), percent(float(share.mean()))
        yield [f"{1e3 * radius:g} mm", *shares, f"{rate:,.0f}"]
