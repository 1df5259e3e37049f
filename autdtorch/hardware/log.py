"""The evaluations of a hardware trial, on disk one by one, and read back."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock

from autdtorch.objectives.objective import validate_magnitudes
from autdtorch.scene.drive import validate_single_drive
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import JsonLines, held, line_of, row_of
from autdtorch.utils.validation import integer_at_least, not_negative, real_tensor, require_kind

logger = logging.getLogger(__name__)

_ORIGIN, _NUMBER = "origin", "evaluation"


class LogError(ValueError):
    """A log belongs to another trial, is in use, or is not a log."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A line of the log.

    Attributes:
        time: time of writing, UTC, ISO 8601.
        drive: (M,), complex128, as requested.
        pressure: (P,) [Pa], float64, as read.
        seconds_on: total time that the outputs were on so far [s].
        deviation: standard deviations (P,) [Pa], as `Readings` has them; None if the sensor tells none.
    """

    time: str
    drive: torch.Tensor
    pressure: torch.Tensor
    seconds_on: float
    deviation: torch.Tensor | None = None


class EvaluationLog:
    """A file with a line of JSON for the trial's settings, for each evaluation, and for each process's end.

    A line is on disk before the next evaluation begins: a process that ends at any moment loses at most the
    evaluation in progress. The log is locked until `end`, or until this object is released.

    Attributes are its `path`, the `origin`, `goes_on`, true if the file existed before, and `seconds_on`, the
    total time that the outputs were on [s].
    """

    def __init__(self, path: str | Path, origin: Mapping[str, Any], transducers: int, points: int) -> None:
        """Begin the file, or read the evaluations of the same trial from it.

        Damaged and incomplete lines are set aside; their evaluations will be made again. The log of another
        trial is overwritten if it holds no evaluation.

        Args:
            path: of the file.
            origin: settings of the trial by name, values of JSON; the first that differs is reported.
            transducers: number of transducers M.
            points: number of control points P.

        Raises:
            LogError: the file is of a trial of another origin, no such log, or open in another process.
            OSError: the file cannot be read or written.
        """
        self.path = Path(path)
        self.origin = json.loads(json.dumps(origin))  # as it will be read back
        self.seconds_on = 0.0
        self._shape = transducers, points
        self._evaluations: dict[int, Evaluation] = {}
        self._lacking = 0  # no evaluation below this number is missing
        self._first_again = math.inf  # number of the first evaluation that was made after later ones
        with contextlib.ExitStack() as held:
            held.enter_context(lock_log(path))
            self._lines, self.goes_on = self._take_up()
            self._lines.mend()
            self._held = held.pop_all()

    @property
    def count(self) -> int:
        """The number of evaluations in the file."""
        return len(self._evaluations)

    @property
    def evaluations(self) -> list[Evaluation]:
        """The evaluations in the file, in the order of their numbers."""
        return [evaluation for _, evaluation in sorted(self._evaluations.items())]

    def recorded(self, number: int, drive: torch.Tensor) -> Evaluation | None:
        """Return the evaluation of a `number`, from 0, and a requested `drive` (M,); None if it must be made.

        An evaluation whose line was lost is made again, and its reading may differ. A later one stays valid
        if the method asks for its drive, and is made again otherwise. `LogError` if the evaluation has
        another drive although no earlier line was lost.
        """
        evaluation = self._evaluations.get(number)
        if evaluation is None or torch.equal(evaluation.drive, drive):
            return evaluation
        if number > self._first_again:
            del self._evaluations[number]  # to be measured again, under its number
            self._lacking = min(self._lacking, number)
            return None
        raise LogError(
            f"{self.path}: evaluation {number + 1} is of another drive than the method asks for; "
            "give the method, seed and version of autdtorch of that trial, or another log"
        )

    def append(
        self,
        drive: torch.Tensor,
        pressure: torch.Tensor,
        seconds_on: float,
        deviation: torch.Tensor | None = None,
    ) -> Evaluation:
        """Add an evaluation under the first number that the log lacks, and return it with its time.

        It has a requested `drive` (M,), the `pressure` (P,) [Pa] as read, and the total time that the outputs
        were on so far, `seconds_on` [s], perhaps standard deviations (P,) [Pa]. `LogError` if the file has
        changed meanwhile.
        """
        while self._lacking in self._evaluations:
            self._lacking += 1
        number = self._lacking
        evaluation = Evaluation(_now(), drive, pressure, seconds_on, deviation)
        asked, read = torch.view_as_real(drive).tolist(), pressure.tolist()
        row = {"time": evaluation.time, "drive": asked, "pressure": read, "seconds_on": seconds_on}
        if deviation is not None:
            row["deviation"] = deviation.tolist()
        self._append({_NUMBER: number, **row})
        self._keep(number, evaluation)
        self.seconds_on = seconds_on
        return evaluation

    def end(self, seconds_on: float) -> None:
        """Record the total time that the outputs were on, `seconds_on` [s], and release the log.

        `LogError` if the file has changed meanwhile.
        """
        with self._held:
            self._append({"time": _now(), "seconds_on": seconds_on})
        self.seconds_on = seconds_on

    def _take_up(self) -> tuple[JsonLines, bool]:
        """Read the file of this trial, or begin it; also return true if it has existed before."""
        head = line_of({_ORIGIN: self.origin}) + b"\n"
        content = self.path.read_bytes() if self.path.exists() else b""
        lines = JsonLines(self.path, digest_of(self.origin), self._use, head)
        if lines.used or content.startswith(head):
            return lines, True
        if not head.startswith(content):
            self._require_empty(content)
        if content:
            os.truncate(self.path, 0)
        return JsonLines(self.path, digest_of(self.origin), self._use, head), False

    def _require_empty(self, content: bytes) -> None:
        """Require that a file without lines of this trial is the log of another, without evaluations."""
        try:
            stored = row_of(content.partition(b"\n")[0])[_ORIGIN]
            require_kind(_ORIGIN, stored, dict)
        except (ValueError, KeyError, RecursionError) as error:
            accepted = "must be the log of a hardware trial, written by this version: give another log"
            raise LogError(f"{self.path}: its first line cannot be read ({error}); {accepted}") from error
        if f'"{_NUMBER}": '.encode() in content:
            raise LogError(
                f"{self.path}: of another trial, whose {_difference(stored, self.origin)}; "
                "give the settings of that trial, or another log"
            )

    def _use(self, row: dict[str, Any]) -> None:
        """Validate a line, and keep its evaluation, if it has one, and its time."""
        datetime.fromisoformat(row["time"])
        seconds_on = not_negative("seconds_on", row["seconds_on"], "s")
        if _NUMBER in row:
            transducers, points = self._shape
            drive = torch.view_as_complex(real_tensor("drive", row["drive"]))
            drive = validate_single_drive(drive, transducers)
            pressure = validate_magnitudes("pressure", row["pressure"], points)
            number = integer_at_least(_NUMBER, row[_NUMBER], 0)
            self._keep(number, Evaluation(row["time"], drive, pressure, seconds_on, _deviation(row)))
        self.seconds_on = max(self.seconds_on, seconds_on)

    def _keep(self, number: int, evaluation: Evaluation) -> None:
        if number < next(reversed(self._evaluations), 0):
            self._first_again = min(self._first_again, number)
        self._evaluations[number] = evaluation

    def _append(self, row: Mapping[str, Any]) -> None:
        try:
            self._lines.append(row)
        except ValueError as error:
            raise LogError(str(error)) from error


def read_log(path: Path) -> tuple[dict[str, Any], list[Evaluation]]:
    """Return the origin of a log and its evaluations in the order of time, without changing the file.

    The last line may have broken off, and is left out with a warning in the log of this program.

    Raises:
        LogError: a damaged line, or no log.
    """
    head, *lines = path.read_bytes().split(b"\n")
    try:
        origin = dict(row_of(head)[_ORIGIN])
    except (ValueError, KeyError, TypeError) as error:
        accepted = "must be the log of a hardware trial, written by this version"
        raise LogError(f"{path}, line 1: cannot be read ({error}); {accepted}") from error
    key, evaluations = digest_of(origin), []
    for number, line in enumerate(lines, 2):
        try:
            row = row_of(line, key) if line else {}
        except ValueError as error:
            if number > len(lines):
                logger.warning("%s, line %d: broke off, and is left out", path, number)
                break
            raise LogError(f"{path}, line {number}: {error}; must be as the trial wrote it") from error
        if _NUMBER in row:
            drive = torch.view_as_complex(real_tensor("drive", row["drive"]))
            pressure = real_tensor("pressure", row["pressure"], "Pa")
            evaluations.append(Evaluation(row["time"], drive, pressure, row["seconds_on"], _deviation(row)))
    return origin, evaluations


def _deviation(row: Mapping[str, Any]) -> torch.Tensor | None:
    if "deviation" not in row:
        return None
    return validate_magnitudes("deviation", row["deviation"], len(row["pressure"]))


@contextlib.contextmanager
def lock_log(path: str | Path) -> Iterator[None]:
    """Keep other processes from a log at `path`, which need not exist; this process may lock it again.

    `LogError` if another process has it.
    """
    place = Path(path).resolve()
    lock = FileLock(place.with_name(f".{place.name}.lock"), thread_local=False, is_singleton=True)
    accepted = "another process has it open for a trial; wait until it ends, or give another log"
    with held(lock, LogError(f"{path}: {accepted}")):
        yield


def _difference(stored: Mapping[str, Any], origin: Mapping[str, Any]) -> str:
    """Describe the difference of two origins in JSON, where 1, 1.0 and true differ, and the order counts."""
    for name in (*origin, *stored):
        texts = [json.dumps(log[name]) if name in log else None for log in (stored, origin)]
        if texts[0] != texts[1]:
            return f"{name} is {stored.get(name, 'absent')}, not {origin.get(name, 'absent')}"
    return f"settings come in another order: {', '.join(stored)}"


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")
