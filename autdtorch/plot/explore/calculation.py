"""The calculations of a live view, in a separate thread: fields, coarse and fine, and methods.

The newest request counts. An older one ends at its next step, so that the picture follows a drag.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import torch

from autdtorch.methods.base import Method, State
from autdtorch.methods.gradient import GradientAscent
from autdtorch.methods.problem import Problem
from autdtorch.methods.run import run
from autdtorch.objectives.bound import focus_bound
from autdtorch.objectives.objective import SimulatedObjective
from autdtorch.plot.explore.situation import Situation
from autdtorch.propagators import (
    FreeSpacePropagator,
    SimulatedPropagator,
    TMatrixPropagator,
    make_propagator,
    volume_field,
)
from autdtorch.propagators.field_forces import forces_on_obstacles
from autdtorch.propagators.propagator import are_shown
from autdtorch.scene.geometry import Plane
from autdtorch.utils.array_types import Array
from autdtorch.utils.progress import Stopped, stopping_when

MadePropagator: TypeAlias = FreeSpacePropagator | TMatrixPropagator | SimulatedPropagator

logger = logging.getLogger(__name__)

_MOST_CELLS = 10_000  # of the plane of a fine field: 0.1 to 0.2 s for the paper's cubes
_CELLS_A_WAVELENGTH = 8
_MOST_PAIRS = 3e8  # of places on plane and Huygens surfaces, in the first fine field: 0.8 s on two cores
_LAYERS = 2  # of cells in a Huygens surface
_NODES = 0.25  # wavelengths between places that radiate; smaller cells are merged
_COARSER = 2  # ratio of the spacings of a coarse and a fine calculation
_COARSE_TOLERANCE = 1e-2  # half the time of the default, where the grid errs by 2 to 5 %
_REST = 1.0  # s without a request before a volume is calculated, which a request does not end
_SCENES = 3  # whose simulations are kept: an undone move is shown at once
_COARSEST = 0.24  # wavelengths; the error of larger cells rises steeply, and each would log a warning


@dataclass(frozen=True)
class Request:
    """A request to calculate.

    Attributes:
        number: its number, which results carry.
        situation: the situation to calculate.
        fine: True for the fine spacing, with an error estimate; False while something is dragged.
        follow: True to search the drive again first.
        volume: True for the field in the domain, too.
        method: the method to run first, if any.
        seed: seed of the method.
    """

    number: int
    situation: Situation
    fine: bool = True
    follow: bool = False
    volume: bool = False
    method: Method | None = None
    seed: int = 0


@dataclass(frozen=True)
class Result:
    """The answer to a request, as far as it is known.

    Attributes:
        request: the request.
        drive: drive (M,) of the situation or of a search.
        spacing: edge of a cell of the simulation [m]; None for a closed form.
        pressure: magnitude at the control points (P,) [Pa].
        field: complex pressure on the plane (Nu, Nv) [Pa], NaN in obstacles and next to transducers.
        bound: upper bound of the weakest focus over all drives [Pa]; None if coarse.
        error: relative error of the transfer matrix; None while it is unknown.
        forces: of the sound on each obstacle (K, 3) [N], NaN if unknown; None while something is dragged.
        volume: pressure in the domain (Nx, Ny, Nz) [Pa]; None while it is unknown, or if not requested.
        seconds: time since the request [s].
    """

    request: Request
    drive: torch.Tensor
    spacing: float | None
    pressure: torch.Tensor
    field: Array
    bound: float | None = None
    error: float | None = None
    forces: torch.Tensor | None = None
    volume: torch.Tensor | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class MethodProgress:
    """The progress of a method: evaluations so far and at most, and the best weakest focus [Pa]."""

    request: Request
    label: str
    evaluations: int
    most: int
    score: float


@dataclass(frozen=True)
class Finished:
    """The end of a request, after which no result of it follows, and the error that ended it, if any."""

    request: Request
    error: Exception | None = None


Report = Result | MethodProgress | Finished


class Calculator:
    """A thread that answers the newest request."""

    def __init__(self, spacing: float, report: Callable[[Report], None]) -> None:
        """Calculate with cells of `spacing` [m] when fine; `report` is called in the thread."""
        self._spacing, self._report = spacing, report
        self._wanted: Request | None = None
        self._changed = threading.Condition()
        self._closed = False
        self._propagators: dict[bool, list[MadePropagator]] = {}  # of the last scenes, fine or not
        self._thread = threading.Thread(target=self._work, name="autdtorch explore", daemon=True)
        self._thread.start()

    def ask(self, request: Request) -> None:
        """Calculate this next, and end the present calculation."""
        with self._changed:
            self._wanted = request
            self._changed.notify()

    def close(self) -> None:
        """End the thread at its next step; drop the propagators, as trame keeps its last server."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self._propagators.clear()

    def _work(self) -> None:
        while (request := self._next()) is not None:
            # while something is dragged, each field is shown, so that the picture follows
            ends = self._is_old if request.fine else lambda: self._closed
            try:
                with stopping_when(ends):
                    for result in self._results(request):
                        self._report(result)
                        if self._is_old():
                            break
            except Stopped:
                continue
            except Exception as error:  # the page shows it; the next request may well succeed
                logger.debug("request %d", request.number, exc_info=True)
                self._report(Finished(request, error))
            else:
                self._report(Finished(request))

    def _next(self) -> Request | None:
        with self._changed:
            self._changed.wait_for(lambda: self._wanted is not None or self._closed)
            request, self._wanted = self._wanted, None
            return None if self._closed else request

    def _is_old(self) -> bool:
        return self._wanted is not None or self._closed

    def _rests(self) -> bool:
        """Return whether no request comes within a while."""
        with self._changed:
            return not self._changed.wait_for(self._is_old, _REST)

    def _results(self, request: Request) -> Iterator[Result | MethodProgress]:
        """Yield ever more complete results of a request."""
        begun = time.monotonic()
        situation, fine = request.situation, request.fine
        propagator = self._propagator(situation, fine)
        drive = situation.drive
        if request.method is not None:
            state = None
            label = request.method.label
            for state in self._steps(request, propagator):
                most, score = request.method.most_evaluations(state.problem), float(state.best.score[0])
                yield MethodProgress(request, label, state.evaluations, most, score)
                if self._is_old():
                    return
            assert state is not None
            drive = request.method.best(state).drive[0]
        elif request.follow:
            drive = _followed(propagator, drive)
        in_closed_form = isinstance(propagator, FreeSpacePropagator) or not propagator.cells
        cells = None if in_closed_form else self._cells(situation, fine)
        step = plane_spacing(situation.sheet, situation.scene.wavelength, fine)
        first = step if cells is None else max(step, quick_spacing(situation, cells))
        result = _field(request, propagator, drive, cells, first)
        yield replace(result, seconds=time.monotonic() - begun)
        if not fine or self._is_old():
            return
        matrix, error = propagator.transfer_matrix(return_error=True)
        pressure = (matrix @ drive).abs()  # of the matrix, so that it does not depend on the plane
        result = replace(result, pressure=pressure, bound=float(focus_bound(matrix)), error=error)
        yield replace(result, seconds=time.monotonic() - begun)
        if situation.bodies and not self._is_old():
            result = replace(result, forces=forces_on_obstacles(propagator, drive))
            yield replace(result, seconds=time.monotonic() - begun)
        if first > step and self._rests():  # readings first, then a sharper picture
            result = replace(result, field=_field(request, propagator, drive, cells, step).field)
            yield replace(result, seconds=time.monotonic() - begun)
        if request.volume and self._rests():
            volume = volume_field(propagator, drive, situation.scene.wavelength / 3)
            yield replace(result, volume=volume, seconds=time.monotonic() - begun)

    def _propagator(self, situation: Situation, fine: bool) -> MadePropagator:
        """Return the propagator of a situation; those of the last scenes are at hand."""
        scene, last = situation.scene, self._propagators.get(fine, [])
        propagator = next((each for each in last if each.scene is scene), None)
        if propagator is None:
            spacing = self._cells(situation, fine)
            if fine:
                propagator = make_propagator(scene, spacing=spacing)
            else:
                propagator = make_propagator(scene, spacing=spacing, tolerance=_COARSE_TOLERANCE)
        others = [each for each in last if each is not propagator]
        self._propagators[fine] = [propagator, *others][:_SCENES]
        return propagator

    def _cells(self, situation: Situation, fine: bool) -> float:
        coarse = min(_COARSER * self._spacing, _COARSEST * situation.scene.wavelength)
        return self._spacing if fine else max(self._spacing, coarse)

    def _steps(self, request: Request, propagator: MadePropagator) -> Iterator[State]:
        assert request.method is not None
        objective = SimulatedObjective(propagator.scene, propagator)
        state = request.method.start(Problem.of(objective), request.seed)
        while not state.done:
            state = request.method.tell(state, objective(request.method.ask(state)))
            yield state


def _followed(propagator: MadePropagator, drive: torch.Tensor) -> torch.Tensor:
    """Return the drive of gradient ascent on the transfer matrix, with a drive (M,) among its starts."""
    objective = SimulatedObjective(propagator.scene, propagator)
    return run(GradientAscent(), objective, start=drive).drive[0]


def _field(
    request: Request, propagator: MadePropagator, drive: torch.Tensor, spacing: float | None, step: float
) -> Result:
    """Return the pressure at the control points and on the plane, from one simulation of the drive.

    Cells of the simulation have an edge of `spacing` [m], those of the plane one of `step` [m].
    """
    situation = request.situation
    grid, foci = situation.sheet.points(step), situation.scene.control_points
    shown = are_shown(situation.scene, grid.reshape(-1, 3))
    points = torch.cat([foci, grid.reshape(-1, 3)[shown]])
    (pressure,) = propagator.field(drive, points[None])  # a grid, which may cross obstacles without a warning
    field = np.full(grid.shape[:2], complex(math.nan, math.nan))
    field[shown.reshape(field.shape).numpy()] = pressure[len(foci) :].numpy()
    return Result(request, drive, spacing, pressure[: len(foci)].abs(), field)


def plane_spacing(sheet: Plane, wavelength: float, fine: bool) -> float:
    """Return the edge of a cell of the plane [m]."""
    least = math.sqrt(sheet.size[0] * sheet.size[1] / _MOST_CELLS)
    return max(wavelength / _CELLS_A_WAVELENGTH, least) * (1 if fine else _COARSER)


def quick_spacing(situation: Situation, cells: float) -> float:
    """Return the edge of a cell of the plane [m] for bodies in cells of an edge `cells` [m].

    Each cell of a Huygens surface radiates to each cell of the plane: large bodies and planes take seconds.
    """
    area = 0.0
    for body in situation.bodies:
        lower, upper = (np.array(corner) for corner in (body.obstacle.lower, body.obstacle.upper))
        a, b, c = np.minimum(upper - lower, np.subtract(*situation.scene.domain[::-1]))
        area += 2 * float(a * b + b * c + c * a)
    width, height = situation.sheet.size
    apart = max(cells, _NODES * situation.scene.wavelength)
    return math.sqrt(width * height * _LAYERS * area / _MOST_PAIRS) / apart
