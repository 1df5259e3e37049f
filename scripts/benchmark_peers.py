"""Run time against error, of Deepwave, Devito, j-Wave and k-wave-python beside our own.

    python scripts/benchmark_peers.py --coarse     grids of 2 mm, to try it
    python scripts/benchmark_peers.py              all

Makes a virtual environment for each peer in `--venvs`, writes peers.json and peers.png and fills in peers.md,
in docs/ or `--output`. Scenes, references, receivers and errors are those of benchmark_accuracy.py: the
transfer matrix of one focus, simulated from the focus by reciprocity, in a domain cut to what matters.
"""

from __future__ import annotations

import argparse
import logging
import math
import shlex
import statistics
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmark_accuracy import ROOT, Case, cube_case, free_space_case, relative_error, simulate, sphere_case
from numpy.typing import NDArray
from peer_environments import run
from peer_report import OURS, Point, Refusal, write_report
from peer_scene import scene_grid
from peers.task import Answer, Task

AIR = "free space"
CASES = {
    AIR: free_space_case,
    "sphere": lambda: sphere_case("sphere"),
    "three cubes": lambda: cube_case("three_cubes"),
    "two cubes": lambda: cube_case("two_cubes"),
}

ENDS = (14, 16, 18, 20, 25, 30, 40, 50, 60)
"""Periods at which a run is judged; the direct sound needs 11 and the ramp 3."""

AIR_PERIODS = 18

OUR_SPACINGS = (2.8, 2.4, 2.0, 1.5, 1.0, 0.75, 0.5)  # [mm]
OUR_TOLERANCE = 1e-2
REPETITIONS = 3
"""Of our runs, of which the median counts: they are short."""


@dataclass(frozen=True)
class Setting:
    """How a peer is run.

    Attributes:
        peer: its name.
        spacing: [mm].
        order: of the differences in space, 0 if spectral.
        offset: of cell centres from the focus [cells]. At 1 mm and less 0 puts focus and transducers on them,
            1/2 the cubes' faces between them.
        steps: time steps a period, in air and with obstacles.
        layer_cells: of its boundary layer.
        periods: after which a run with obstacles ends.
        cases: that it is run in.
    """

    peer: str
    spacing: float
    order: int
    offset: float
    steps: tuple[int, int]
    layer_cells: int
    periods: int
    cases: tuple[str, ...] = tuple(CASES)

    def __str__(self) -> str:
        """What tells settings of a peer apart."""
        order = f"order {self.order}, " if self.order else ""
        return f"{self.spacing:g} mm, {order}focus {'between cells' if self.offset else 'on a cell'}"


SETTINGS = (
    *(
        Setting(peer, spacing, order, offset, steps, layer, periods)
        for peer, order, spacing, steps, layer, periods in (
            ("deepwave", 8, 2.0, (10, 19), 8, 60),
            ("deepwave", 4, 1.0, (18, 29), 10, 60),
            ("deepwave", 8, 1.0, (19, 37), 10, 60),
            ("devito", 8, 2.0, (10, 12), 8, 60),
            ("devito", 4, 1.0, (18, 22), 10, 60),
            ("devito", 8, 1.0, (19, 25), 10, 60),
            ("jwave", 0, 2.0, (14, 14), 8, 60),
        )
        for offset in (0.0, 0.5)
    ),
    Setting("deepwave", 0.5, 4, 0.5, (35, 58), 16, 40),
    Setting("devito", 0.5, 4, 0.5, (35, 45), 12, 50),
    Setting("jwave", 1.0, 0, 0.5, (29, 29), 10, 30),
    Setting("kwave", 2.0, 0, 0.0, (14, 14), 8, 20),
    Setting("kwave", 1.0, 0, 0.5, (29, 29), 10, 30, (AIR, "three cubes")),
)


def simulate_peer(case: Case, setting: Setting, venvs: Path) -> tuple[Answer, Task, NDArray[np.complex128]]:
    """A peer's answer, its task, and the transfer matrix (E, M) at the task's ends, up to a factor."""
    scene, in_air = case.scene, not case.scene.obstacles
    spacing = setting.spacing * 1e-3
    grid = scene_grid(scene, spacing, setting.offset, setting.layer_cells, smooth=setting.order == 0)
    steps = setting.steps[0 if in_air else 1]
    # A leapfrog of this step turns by a whole period in as many; k-space schemes do of themselves.
    leapfrog = math.sin(math.pi / steps) * steps / math.pi if setting.order else 1.0
    last = min(setting.periods, AIR_PERIODS) if in_air else setting.periods
    task = Task(
        density=grid.density,
        sound_speed=scene.medium.sound_speed,
        spacing=spacing,
        frequency=scene.frequency,
        time_step=leapfrog / (steps * scene.frequency),
        steps_per_period=steps,
        source_cells=grid.source_cells,
        source_weights=grid.source_weights,
        receiver_cells=grid.receiver_cells,
        ends=np.array([end for end in ENDS if end <= last]),
        layer_cells=setting.layer_cells,
        order=setting.order,
    )
    with tempfile.TemporaryDirectory() as folder:
        asked, answered = Path(folder) / "task.npz", Path(folder) / "answer.npz"
        task.save(asked)
        run(setting.peer, venvs, asked, answered)
        answer = Answer.load(answered)
    return answer, task, answer.phasors @ grid.receiver_weights.T


def peer_points(setting: Setting, venvs: Path) -> Iterator[Point | Refusal]:
    """What a peer reaches in each case, free space first, which its strength and phase are fitted to."""
    factor = None
    for name in setting.cases:
        case = CASES[name]()
        try:
            answer, task, found = simulate_peer(case, setting, venvs)
        except subprocess.CalledProcessError as error:
            yield Refusal(name, setting.peer, str(setting), reason(error))
            return
        if not np.isfinite(found).all():
            yield Refusal(name, setting.peer, str(setting), "the run diverged")
            continue
        exact = case.exact[0].numpy()
        if factor is None:
            factor = np.vdot(found[-1], exact) / np.vdot(found[-1], found[-1])
        rate = answer.updated_cells * task.steps / answer.stepping_seconds
        for end, matrix in zip(task.ends.tolist(), found, strict=True):
            seconds = answer.setup_seconds + answer.stepping_seconds * end / task.ends[-1]
            error = float(np.linalg.norm(factor * matrix - exact) / np.linalg.norm(exact))
            left = float(np.linalg.norm(matrix - found[-1]) / np.linalg.norm(found[-1]))
            yield Point(name, setting.peer, str(setting), end, left, error, float(seconds), rate)
        print(f"{name}, {setting.peer}, {setting}: {100 * error:.3g} %, {seconds:.3g} s", flush=True)


def reason(error: subprocess.CalledProcessError) -> str:
    """The last line of what a failed program said."""
    return (error.stderr.strip() or str(error)).splitlines()[-1]


def our_points(name: str) -> Iterator[Point]:
    """What our own solver reaches in a case."""
    case = CASES[name]()
    simulate(case, OUR_SPACINGS[0])  # compiles the kernel
    for spacing in OUR_SPACINGS:
        found = [simulate(case, spacing, OUR_TOLERANCE) for _ in range(REPETITIONS)]
        seconds = statistics.median(one.seconds for one in found)
        error = relative_error(found[0].matrix, case.exact)
        print(f"{name}, {OURS}, {spacing:g} mm: {100 * error:.3g} %, {seconds:.3g} s", flush=True)
        yield Point(name, OURS, f"{spacing:g} mm", None, OUR_TOLERANCE, error, seconds, None)


def measure(settings: Sequence[Setting], venvs: Path) -> tuple[list[Point], list[Refusal]]:
    """All measurements, and what did not run."""
    points: list[Point] = [one for name in CASES for one in our_points(name)]
    refusals: list[Refusal] = []
    for setting in settings:
        for one in peer_points(setting, venvs):
            if isinstance(one, Point):
                points.append(one)
            else:
                print(f"{one.case}, {one.program}, {one.setting}: {one.reason}", flush=True)
                refusals.append(one)
    return points, refusals


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--coarse", action="store_true", help="peers on grids of 2 mm alone")
    parser.add_argument("--venvs", type=Path, default=Path.home() / ".cache" / "autdtorch" / "peers")
    parser.add_argument("--output", type=Path, default=ROOT / "docs")
    given = parser.parse_args()
    logging.getLogger("autdtorch").setLevel(logging.ERROR)  # coarse grids are meant
    settings = [one for one in SETTINGS if one.spacing == 2 or not given.coarse]
    points, refusals = measure(settings, given.venvs)
    shown = ["python", "scripts/benchmark_peers.py", *(["--coarse"] if given.coarse else [])]
    write_report(points, refusals, shlex.join(shown), given.output)


if __name__ == "__main__":
    main()
