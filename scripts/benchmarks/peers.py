"""Run time against error of Deepwave, Devito, j-Wave and k-wave-python beside ours.

Makes a virtual environment for each peer in `--venvs`, then writes peers.png and a block of the
documentation. Scenes, receivers and errors are those of `benchmark.py accuracy`: the transfer matrix of one
focus, simulated from the focus by reciprocity. `--coarse` is a trial.
"""

import logging
import math
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from benchmarks.peer_programs.task import Answer, Task
from benchmarks.peer_scene import scene_grid
from matplotlib.figure import Figure
from numpy.typing import NDArray
from shared.cases import Case, cube_case, free_space_case, simulate, sphere_case
from shared.document import Page, command_line, percent, table
from shared.scenes import relative_error

from autdtorch.plot.cost_figures import plot_pareto
from autdtorch.plot.style import TICK_SIZE

DOCUMENT = "performance.md"

PACKAGES: dict[str, tuple[str, ...]] = {
    "deepwave": ("torch==2.13.0", "numpy==2.4.6", "deepwave==0.1.0"),
    "devito": ("devito==4.8.23",),
    "jwave": ("jwave==0.2.1", "jax==0.4.38"),
    "kwave": ("k-wave-python==0.6.2",),
}
"""Packages of each peer; an environment each, as their dependencies exclude one another."""

PROGRAMS = Path(__file__).parent / "peer_programs"
VENVS = Path.home() / ".cache" / "autdtorch" / "peers"

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
"""Repetitions of our short runs; the median counts."""


OURS = "autdtorch"
NAMES = {"deepwave": "Deepwave", "devito": "Devito", "jwave": "j-Wave", "kwave": "k-wave-python"}

ERROR = 0.1
"""Error to which run times are compared."""

STEADY = 1e-2
"""Relative distance to the end of the run within which a peer counts as steady; our default tolerance."""

OPTIONS = {
    "--coarse": {"action": "store_true", "help": "peers on grids of 2 mm alone"},
    "--venvs": {"type": Path, "default": VENVS, "help": "folder of the peers' environments"},
}


def main(page: Page, coarse: bool, venvs: Path) -> None:
    logging.getLogger("autdtorch").setLevel(logging.ERROR)  # grids are coarse on purpose
    settings = [setting for setting in SETTINGS if setting.spacing == 2 or not coarse]
    points: list[Point] = []
    refusals: list[Refusal] = []
    for outcome in measure(settings, venvs):
        if isinstance(outcome, Point):
            points.append(outcome)
            summary = f"{percent(outcome.error)}, {outcome.seconds:.3g} s"
        else:
            refusals.append(outcome)
            summary = outcome.reason
        print(f"{outcome.case}, {outcome.program}, {outcome.setting}: {summary}", flush=True)
    write_report(points, refusals, page)


@dataclass(frozen=True)
class Setting:
    """The settings of a peer's run.

    `offset` moves the cell centres away from the focus [cells]. At 1 mm and less, 0 puts focus and
    transducers on cell centres, 1/2 the faces of the cubes between them.
    """

    peer: str
    spacing: float  # [mm]
    order: int  # of the differences in space; 0 for spectral
    offset: float
    steps: tuple[int, int]  # time steps per period, in air and with obstacles
    layer_cells: int  # of its absorbing layer
    periods: int  # after which a run with obstacles ends
    cases: tuple[str, ...] = tuple(CASES)

    def __str__(self) -> str:
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


@dataclass(frozen=True)
class Point:
    """A measurement of a scene by a program."""

    case: str
    program: str
    setting: str
    periods: int | None  # after which the run ended; None if it decided itself
    remaining: float  # relative distance to the steady state, or to the end of the run
    error: float  # complex relative L2 error of the transfer matrix
    seconds: float  # without imports and compilation


@dataclass(frozen=True)
class Refusal:
    """A setting that did not run, and the reason."""

    case: str
    program: str
    setting: str
    reason: str


def python_of(peer: str, folder: Path) -> Path:
    """Return the interpreter of a peer's environment in `folder`, made if it lacks the packages."""
    environment = folder / peer
    python, done = environment / "bin" / "python", environment / "installed.txt"
    wanted = "\n".join(PACKAGES[peer])
    if not done.exists() or done.read_text(encoding="utf-8") != wanted:
        print(f"{peer}: installing {', '.join(PACKAGES[peer])} in {environment}", flush=True)
        for command in (
            [sys.executable, "-m", "venv", "--clear", str(environment)],
            [str(python), "-m", "pip", "install", "--quiet", *PACKAGES[peer]],
        ):
            subprocess.run(command, check=True, capture_output=True, text=True)
        done.write_text(wanted, encoding="utf-8")
    return python


def task_of(case: Case, setting: Setting) -> tuple[Task, NDArray[np.float64]]:
    """Return the task of a peer, and the weights (M, R) of its receivers for each transducer."""
    scene, in_air = case.scene, not case.scene.obstacles
    spacing = setting.spacing * 1e-3
    grid = scene_grid(scene, spacing, setting.offset, setting.layer_cells, smooth=setting.order == 0)
    steps = setting.steps[0 if in_air else 1]
    # A leapfrog with this step advances a whole period in `steps`; k-space schemes do so by themselves.
    leapfrog = math.sin(math.pi / steps) * steps / math.pi if setting.order else 1.0
    last = min(setting.periods, AIR_PERIODS) if in_air else setting.periods
    parts = {name: getattr(grid, name) for name in vars(grid) if name != "receiver_weights"}
    task = Task(
        **parts,
        sound_speed=scene.medium.sound_speed,
        spacing=spacing,
        frequency=scene.frequency,
        time_step=leapfrog / (steps * scene.frequency),
        steps_per_period=steps,
        ends=np.array([end for end in ENDS if end <= last]),
        layer_cells=setting.layer_cells,
        order=setting.order,
    )
    return task, grid.receiver_weights


def answer_of(peer: str, task: Task, venvs: Path) -> Answer:
    """Return a peer's answer; subprocess.CalledProcessError if it fails."""
    with tempfile.TemporaryDirectory() as folder:
        asked, answered = Path(folder) / "task.npz", Path(folder) / "answer.npz"
        task.save(asked)
        program = [str(python_of(peer, venvs)), str(PROGRAMS / f"{peer}_peer.py")]
        subprocess.run([*program, str(asked), str(answered)], check=True, capture_output=True, text=True)
        return Answer.load(answered)


def peer_points(setting: Setting, venvs: Path) -> Iterator[Point | Refusal]:
    """Measure a peer in each case; free space, which comes first, fixes its source strength and phase."""
    factor = None
    for name in setting.cases:
        case = CASES[name]()
        task, weights = task_of(case, setting)
        try:
            answer = answer_of(setting.peer, task, venvs)
        except subprocess.CalledProcessError as error:
            reason = (error.stderr.strip() or str(error)).splitlines()[-1]
            yield Refusal(name, setting.peer, str(setting), reason)
            return
        matrices = answer.phasors @ weights.T  # transfer matrix (E, M) at the task's ends, up to a factor
        if not np.isfinite(matrices).all():
            yield Refusal(name, setting.peer, str(setting), "the run diverged")
            continue
        exact, last = case.exact[0].numpy(), matrices[-1]
        if factor is None:
            factor = np.vdot(last, exact) / np.vdot(last, last)
        for end, matrix in zip(task.ends.tolist(), matrices, strict=True):
            seconds = answer.setup_seconds + answer.stepping_seconds * end / task.ends[-1]
            error = float(np.linalg.norm(factor * matrix - exact) / np.linalg.norm(exact))
            left = float(np.linalg.norm(matrix - last) / np.linalg.norm(last))
            yield Point(name, setting.peer, str(setting), end, left, error, float(seconds))


def our_points(name: str) -> Iterator[Point]:
    case = CASES[name]()
    simulate(case, OUR_SPACINGS[0])  # compiles the kernel
    for spacing in OUR_SPACINGS:
        runs = [simulate(case, spacing, OUR_TOLERANCE) for _ in range(REPETITIONS)]
        seconds = statistics.median(run.seconds for run in runs)
        error = relative_error(runs[0].matrix, case.exact)
        yield Point(name, OURS, f"{spacing:g} mm", None, OUR_TOLERANCE, error, seconds)


def measure(settings: Sequence[Setting], venvs: Path) -> Iterator[Point | Refusal]:
    for name in CASES:
        yield from our_points(name)
    for setting in settings:
        yield from peer_points(setting, venvs)


def write_report(points: Sequence[Point], refusals: Sequence[Refusal], page: Page) -> None:
    steady = list(settled(points))
    parts = [
        "![Error over run time](peers.png)",
        f"Shortest time [s] of steady runs to an error of {percent(ERROR)}, and the least error [%], on any "
        "grid:",
        times(steady),
    ]
    if refusals:
        lines = [[r.case, NAMES[r.program], r.setting, r.reason] for r in refusals]
        parts.append(table(["scene", "program", "setting", "did not run"], lines))
    page.write(*parts)
    page.save("peers.png", figure(points))


def settled(points: Sequence[Point]) -> Iterator[Point]:
    """Yield the first point of each run after which it stays in the steady state."""
    for _, run in groupby(points, lambda point: (point.case, point.program, point.setting)):
        run = list(run)
        late = [index for index, point in enumerate(run) if point.remaining > STEADY]
        yield run[late[-1] + 1 if late else 0]


def times(steady: Sequence[Point]) -> str:
    """Return a table of the shortest run times to `ERROR`, and of the least errors, of each program."""
    programs = list(dict.fromkeys(p.program for p in steady))
    lines = []
    for case in dict.fromkeys(p.case for p in steady):
        runs = [[p for p in steady if (p.case, p.program) == (case, program)] for program in programs]
        lines.append([case, *map(time_and_error, runs)])
    return table(["scene", *(NAMES.get(program, program) for program in programs)], lines)


def time_and_error(run: Sequence[Point]) -> str:
    """Return the shortest time [s] to `ERROR`, or a dash, and the least error [%]; "" without points."""
    seconds = [f"{p.seconds:.3g}" for p in sorted(run, key=lambda p: p.seconds) if p.error <= ERROR]
    return f"{seconds[0] if seconds else '-'}, {100 * min(p.error for p in run):.3g}" if run else ""


def figure(points: Sequence[Point]) -> Figure:
    """Plot error over run time, a panel for each scene; errors over 100 % are left out."""
    values: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for point in points:
        if point.error <= 1:
            by_program = values.setdefault(point.case, {})
            program = NAMES.get(point.program, point.program)
            by_program.setdefault(program, []).append((point.seconds, 100 * point.error))
    drawn = plot_pareto(
        values, "run time of the transfer matrix of one focus [s]", "relative error of the field [%]"
    )
    drawn.supxlabel(command_line(), fontsize=TICK_SIZE)
    return drawn
