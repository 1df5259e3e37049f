"""Errors of a thermal camera: pressures, places and their deviations, by screen, time and noise.

The frames come from finite differences of the heat in a screen and a camera at an angle (`heated_screen`),
not from the cosines of the inversion. Writes camera.png and a block of the documentation.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from matplotlib.axes import Axes
from shared.document import Page, printed, quartiles, table
from shared.heated_screen import WAVELENGTH, HeatedScreen, focused_drive, magnitudes, pinhole

import autdtorch as at
from autdtorch.hardware.camera.heat import HeatInversion
from autdtorch.hardware.camera.picture import Picture
from autdtorch.hardware.camera.registration import Registration, registered_by_foci
from autdtorch.hardware.camera.screen import Screen
from autdtorch.plot import style

DOCUMENT = "camera.md"
OPTIONS = {"--seeds": {"type": int, "default": 20, "help": "random foci for each row and each dot"}}

PLANE = at.Plane((0.0, 0.0, 0.15), (0.0, 0.0, 1.0), (0.06, 0.06))
SHAPE, COUNTS, PITCH = (96, 112), (75, 75), 0.8e-3  # of images and pictures; of pixels [m]
ARRAY = at.TransducerArray.grid((16, 16), 10e-3, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
FOCI, RATE, BEFORE = 4, 30.0, 0.3  # frames per second, and the time of those before the sound [s]
PRESSURES = 1000.0, 2000.0, 4000.0
THICKNESSES, DURATIONS, NOISES = (10, 20, 40, 80, 160), (0.2, 0.5, 1.0, 2.0), (0.02, 0.05, 0.1, 0.2)


@dataclass(frozen=True)
class Case:
    """The conditions of a picture: screen [m], sound [s], noise of a pixel [K] and mean pressure of foci."""

    thickness: float = 28e-6
    duration: float = 1.0
    noise: float = 0.05
    pressure: float = 1000.0


class Bench:
    """Random foci on a screen before a camera in a random pose; equal heat is computed once."""

    def __init__(self, seed: int) -> None:
        """Draw foci, 12 mm apart, their drive, and the camera."""
        self.rng = np.random.default_rng(seed)
        places = np.zeros((0, 2))
        while len(places) < FOCI:
            place = self.rng.uniform(-0.4, 0.4, (1, 2)) * PLANE.size
            if np.all(np.linalg.norm(places - place, axis=1) > 12e-3):
                places = np.concatenate([places, place])
        self.foci = torch.tensor(PLANE.center) + torch.nn.functional.pad(torch.from_numpy(places), (0, 1))
        self.drive = focused_drive(ARRAY, self.foci, torch.Generator().manual_seed(seed))
        self.registration = random_camera(self.rng)
        self.view = HeatedScreen(self.registration, SHAPE)
        self.unit = magnitudes(ARRAY, self.drive, self.view.points)
        self.latency, self.phase = self.rng.uniform(0, 0.1), self.rng.uniform(0, 1 / RATE)
        self._heat: dict[tuple[Screen, float], np.ndarray] = {}
        self._inversions: dict[Screen, HeatInversion] = {}

    def picture(self, case: Case) -> Picture:
        screen = self.view.screen = Screen.of_thickness(case.thickness)
        times = np.arange(-BEFORE, case.duration, 1 / RATE) + self.phase
        if (screen, case.duration) not in self._heat:
            rises = self.view.rises(self.unit, times - self.latency, case.duration)
            self._heat[screen, case.duration] = rises
        frames = self.scale(case) ** 2 * self._heat[screen, case.duration] + self.rng.normal(22, 0.3, SHAPE)
        frames += self.rng.normal(0, 0.01) * times[:, None, None] + self.rng.normal(
            0, case.noise, frames.shape
        )
        if screen not in self._inversions:
            inversion = HeatInversion(self.registration, SHAPE, COUNTS, WAVELENGTH, screen)
            self._inversions[screen] = inversion
        return self._inversions[screen].picture(times, frames, case.duration)

    def scale(self, case: Case) -> float:
        """Return the source strength [Pa m] with which the foci have their mean pressure."""
        return float(case.pressure / magnitudes(ARRAY, self.drive, self.foci).mean())

    def errors(self, case: Case) -> dict[str, np.ndarray]:
        """Return errors of foci: relative, stated and in mm; squares of errors of |p|^2 by stated ones."""
        picture, scale = self.picture(case), self.scale(case)
        truth = scale * magnitudes(ARRAY, self.drive, self.foci)
        pressure, deviation = picture.at(self.foci)
        shifts = (picture.foci(self.foci, 4e-3) - loudest(self.drive, self.foci)).norm(dim=1)
        plane = scale * magnitudes(ARRAY, self.drive, picture.points).reshape(COUNTS)
        ratios = squared_deviations(picture, plane, 0.3 * case.pressure)
        return {
            "focus": (pressure / truth - 1).numpy(),
            "stated": (deviation / truth).numpy(),
            "place": 1e3 * shifts.numpy(),
            "ratio": ((pressure - truth) / deviation).square().numpy(),
            **{name: np.array([ratio]) for name, ratio in ratios.items()},
        }


def random_camera(rng: np.random.Generator) -> Registration:
    """Return a camera that is tilted by up to 0.6 and rolled by up to 0.5 rad."""
    return pinhole(PLANE, SHAPE, rng.uniform(0, 0.6), PITCH, rng.uniform(-0.5, 0.5))


def squared_deviations(picture: Picture, truth: torch.Tensor, loud: float) -> dict[str, float]:
    """Return mean squared errors of |p|^2, by stated ones, of cells that are loud, dark, and at edges."""
    square = picture.pressure.square()
    stated = (picture.pressure + picture.deviation).square() - square
    errors = ((square - truth.square()) / stated).square()
    edge = torch.ones_like(errors, dtype=torch.bool)
    edge[3:-3, 3:-3] = False
    masks = {"loud": truth > loud, "dark": truth <= loud, "edge": edge}
    return {name: float(errors[mask].mean()) for name, mask in masks.items()}


def loudest(drive: torch.Tensor, near: torch.Tensor, radius: float = 4e-3) -> torch.Tensor:
    """Return the places (P, 3) of the largest |p| within a radius of points, in the plane, to 0.02 mm."""
    places, step = near, radius / 4
    while step > 0.01e-3:
        grid = torch.cartesian_prod(*[torch.arange(-4.0, 5.0, dtype=torch.float64)] * 2) * step
        around = places[:, None] + torch.nn.functional.pad(grid, (0, 1))
        half = torch.tensor([*PLANE.size, 1.0]) / 2
        around = torch.tensor(PLANE.center) + (around - torch.tensor(PLANE.center)).clamp(-half, half)
        values = magnitudes(ARRAY, drive, around.reshape(-1, 3)).reshape(len(near), -1)
        values[(around - near[:, None]).norm(dim=2) > radius] = 0.0
        places, step = around[torch.arange(len(near)), values.argmax(dim=1)], step / 3
    return places


def main(page: Page, seeds: int) -> None:
    """Measure; print all rows, and write block and figure."""
    benches = [Bench(seed) for seed in range(seeds)]

    def gathered(case: Case) -> dict[str, np.ndarray]:
        parts = [bench.errors(case) for bench in benches]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    rows = printed(summary(pressure, gathered(Case(pressure=pressure))) for pressure in PRESSURES)
    marks = registration_errors(seeds)
    print("registration [mm]", quartiles(marks, ".2g"))
    figure = style.new_figure(7.2, 2.6)
    series = {
        "thickness of the screen [µm]": [(each, Case(thickness=1e-6 * each)) for each in THICKNESSES],
        "time of heating [s]": [(each, Case(duration=each)) for each in DURATIONS],
        "noise of a pixel [mK]": [(1e3 * each, Case(noise=each)) for each in NOISES],
    }
    panels = figure.subplots(1, len(series), sharey=True)
    for ax, (label, cases) in zip(panels, series.items(), strict=True):
        draw(ax, label, cases, gathered)
    panels[0].set_ylabel("error of |p| at a focus [%]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(handles))
    page.save("camera.png", figure)
    page.write(
        "![Error of the pressure over thickness, time and noise](camera.png)",
        f"Error of |p| at a focus: medians and quartiles of {seeds} seeds, and dots as stated. Where an axis "
        "does not say otherwise: a polyester mesh of 28 µm, 1 s, 50 mK, 30 frames/s, pixels of 0.8 mm.",
        table(
            [
                "peaks",
                "error of a pressure [%]",
                "as stated",
                "place [mm]",
                "foci",
                "loud cells",
                "dark cells",
                "edges",
            ],
            rows,
        ),
        "Last four columns: rms errors over stated ones. Registered by nine foci of 2 kPa, places are "
        f"{quartiles(marks, '.2g')} mm off.",
    )


def summary(pressure: float, errors: dict[str, np.ndarray]) -> list[str]:
    ratios = [f"{math.sqrt(errors[name].mean()):.2f}" for name in ("ratio", "loud", "dark", "edge")]
    stated = f"{100 * np.median(errors['stated']):.2g}"
    return [
        f"{1e-3 * pressure:g} kPa",
        quartiles(100 * np.abs(errors["focus"]), ".2g"),
        stated,
        quartiles(errors["place"], ".2g"),
        *ratios,
    ]


def registration_errors(seeds: int) -> np.ndarray:
    """Return the errors [mm] of places of the plane that cameras in random poses registered by foci."""
    marks = torch.tensor([(x, y, PLANE.center[2]) for x in (-0.025, 0, 0.025) for y in (-0.025, 0, 0.025)])
    marks = marks.double()
    heat, rises = HeatedScreen(random_camera(np.random.default_rng(0)), SHAPE), []
    for mark in marks:
        drive = focused_drive(ARRAY, mark[None], torch.Generator().manual_seed(0))
        scale = 2000.0 / magnitudes(ARRAY, drive, mark[None])
        rises.append(
            heat.temperatures(scale * magnitudes(ARRAY, drive, heat.points), np.array([0.9]), 1.0)[0]
        )
    return np.concatenate([one_registration(seed, np.stack(rises), marks) for seed in range(seeds)])


def one_registration(seed: int, rises: np.ndarray, marks: torch.Tensor) -> np.ndarray:
    """Return the errors [mm] of 100 places; spots are five frames before the end, less five before 0."""
    rng = np.random.default_rng(seed)
    camera = random_camera(rng)
    images = HeatedScreen(camera, SHAPE).images(rises)
    images += rng.normal(0, 0.05 * (2 / 5) ** 0.5, images.shape)
    registration = registered_by_foci(PLANE, list(images), marks)
    places = rng.uniform(-0.5, 0.5, (100, 2)) * PLANE.size
    return 1e3 * np.linalg.norm(registration.to_plane(camera.to_pixels(places)) - places, axis=1)


def draw(
    ax: Axes, label: str, cases: list[tuple[float, Case]], gathered: Callable[[Case], dict[str, np.ndarray]]
) -> None:
    """Draw median, quartiles and stated errors of each pressure over an axis."""
    x = [value for value, _ in cases]
    for colour, pressure in zip(("#0072B2", "#D55E00", "#009E73"), PRESSURES, strict=True):
        errors = [gathered(replace(case, pressure=pressure)) for _, case in cases]
        low, middle, high = 100 * np.quantile(
            np.stack([np.abs(each["focus"]) for each in errors]), [0.25, 0.5, 0.75], axis=1
        )
        # the median of a normal error is 0.67 deviations
        stated = [67 * np.median(each["stated"]) for each in errors]
        ax.fill_between(x, low, high, color=colour, alpha=0.2, lw=0)
        ax.plot(x, middle, color=colour, lw=1.2, label=f"{1e-3 * pressure:g} kPa")
        ax.plot(x, stated, color=colour, marker="o", ms=3, lw=0)
        print(
            label, pressure, *(f"{v:g}: {m:.3g} ({s:.3g})" for v, m, s in zip(x, middle, stated, strict=True))
        )
    ax.set(xscale="log", yscale="log", xlabel=label)
    ax.set_xticks(x, [f"{value:g}" for value in x], fontsize=style.TICK_SIZE)
    ax.minorticks_off()
    ax.grid(color="0.9", lw=0.6)
