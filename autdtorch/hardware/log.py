"""The evaluations of a hardware trial, on disk one by one, and read back."""

from __future__ import annotations

import contextlib
import json
import logging
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock

from autdtorch.drive import validate_single_drive
from autdtorch.locking import held
from autdtorch.validation import invalid, not_negative, real_tensor
from autdtorch.writing import naming

logger = logging.getLogger(__name__)

_ORIGIN = "origin"


class LogError(ValueError):
    """A log is of another trial, in use, or none."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A line of the log.

    Attributes:
        time: when it was written, UTC, ISO 8601.
        drive: (M,), complex128, as it was asked for.
        pressure: (P,) [Pa], float64, as it was read.
        seconds_on: how long the outputs were on so far [s].
    """

    time: str
    drive: torch.Tensor
    pressure: torch.Tensor
    seconds_on: float


class EvaluationLog:
    """A line of JSON that says what the trial is, one for each evaluation, one for the end of each process.

    A line is on disk before the next evaluation begins, so that the end of the process, at whatever moment,
    costs at most the evaluation in flight. Other processes are kept from the log until `end`, or until nobody
    holds this object any more.

    Attributes:
        path: of the file.
        origin: what the trial is, by name.
        evaluations: what the file holds.
        goes_on: whether the file was there before.
        seconds_on: how long the outputs were on in all, as its lines say [s].
    """

    path: Path
    origin: dict[str, Any]
    evaluations: list[Evaluation]
    goes_on: bool
    seconds_on: float

    def __init__(self, path: str | Path, origin: Mapping[str, Any], transducers: int, points: int) -> None:
        """Begin the file, or read what it holds of the same trial.

        A last line that broke off is removed. A log without evaluations, of another trial, is begun anew.

        Args:
            path: of the file.
            origin: what the trial is: what JSON can hold, by name, the most telling first.
            transducers: M, of each drive.
            points: P, of each pressure.

        Raises:
            LogError: the file is of a trial of another origin, no such log, or open in another process.
            OSError: the file cannot be read or written.
        """
        self.path = Path(path)
        self.origin = json.loads(json.dumps(origin))  # as it will be read back
        self.evaluations = []
        self.seconds_on = 0.0
        with contextlib.ExitStack() as held:
            held.enter_context(lock_log(path))
            self.goes_on = self._take_up(transducers, points)
            self._held = held.pop_all()

    def append(self, drive: torch.Tensor, pressure: torch.Tensor, seconds_on: float) -> None:
        """Add an evaluation.

        Args:
            drive: (M,), as it was asked for.
            pressure: (P,) [Pa], as it was read.
            seconds_on: how long the outputs were on so far [s].

        Raises:
            LogError: the file has changed meanwhile.
            OSError: the file cannot be written.
        """
        time = _now()
        self._append(
            {
                "time": time,
                "drive": torch.view_as_real(drive).tolist(),
                "pressure": pressure.tolist(),
                "seconds_on": seconds_on,
            }
        )
        self.evaluations.append(Evaluation(time, drive, pressure, seconds_on))
        self.seconds_on = seconds_on

    def end(self, seconds_on: float) -> None:
        """Say how long the outputs were on when the process ends, its other playing included.

        Args:
            seconds_on: how long the outputs were on so far [s].

        Raises:
            LogError: the file has changed meanwhile.
            OSError: the file cannot be written.
        """
        with self._held:
            self._append({"time": _now(), "seconds_on": seconds_on})
        self.seconds_on = seconds_on

    def _take_up(self, transducers: int, points: int) -> bool:
        """Read the file if it is of this trial, else begin it; returns whether it was there."""
        content = self.path.read_bytes() if self.path.exists() else b""
        self._size = content.rfind(b"\n") + 1
        if not self._size and _line({_ORIGIN: self.origin}).startswith(content):
            self._begin()
            return False
        stored, *rows = _rows(self.path, content[: self._size])
        if stored[_ORIGIN] != self.origin:
            if any(row.keys() != {"time", "seconds_on"} for row in rows):
                raise self._of_another_trial(stored[_ORIGIN])
            self._begin()
            return False
        for number, row in enumerate(rows, 2):
            with _line_named(self.path, number):
                if "drive" in row:
                    self.evaluations.append(_evaluation(row, transducers, points))
                self.seconds_on = max(self.seconds_on, not_negative("seconds_on", row["seconds_on"], "s"))
        if self._size < len(content):
            logger.warning("%s: the last line broke off; its evaluation will be made again", self.path)
            os.truncate(self.path, self._size)
        return True

    def _begin(self) -> None:
        if self.path.exists():
            os.truncate(self.path, 0)
        self._size = 0
        self._append({_ORIGIN: self.origin})

    def _of_another_trial(self, stored: Mapping[str, Any]) -> LogError:
        name = next(one for one in (*self.origin, *stored) if stored.get(one) != self.origin.get(one))
        return LogError(
            f"{self.path}: of another trial, whose {name} is {stored.get(name)}, not "
            f"{self.origin.get(name)}; give the settings of that trial, or another log"
        )

    def _append(self, row: Mapping[str, Any]) -> None:
        """Add a line, or leave the file as it is: nothing may follow half a line."""
        rest = memoryview(_line(row))
        with naming(self.path), self.path.open("ab", buffering=0) as file:
            if file.tell() != self._size:  # the lock does not part objects of one process
                raise LogError(f"{self.path}: has changed meanwhile; open it anew, or give another log")
            try:
                while rest:
                    rest = rest[file.write(rest) :]
                os.fsync(file.fileno())
                self._size = file.tell()
            except BaseException:
                file.truncate(self._size)
                raise


@contextlib.contextmanager
def lock_log(path: str | Path) -> Iterator[None]:
    """Keep other processes from a log; this one may lock it once more, as a notebook does.

    Args:
        path: of the file, which need not be there yet.

    Raises:
        LogError: another process has it.
        OSError: its folder cannot be written.
    """
    place = Path(path).resolve()
    lock = FileLock(place.with_name(f".{place.name}.lock"), thread_local=False, is_singleton=True)
    accepted = "another process has it open for a trial; wait until it ends, or give another log"
    with held(lock, LogError(f"{path}: {accepted}")):
        yield


def _line(row: Mapping[str, Any]) -> bytes:
    return json.dumps(row).encode() + b"\n"


def _rows(path: Path, content: bytes) -> list[dict[str, Any]]:
    """The lines; the first is of the origin alone."""
    rows = []
    for number, line in enumerate(content.splitlines(), 1):
        with _line_named(path, number):
            rows.append(_object(line))
    if not rows or rows[0].keys() != {_ORIGIN} or not isinstance(rows[0][_ORIGIN], dict):
        raise LogError(f"{path}: not the log of a hardware trial; give another log")
    return rows


def _object(line: bytes) -> dict[str, Any]:
    with contextlib.suppress(ValueError):
        if isinstance(row := json.loads(line), dict):
            return row
    raise ValueError("no JSON object")


@contextlib.contextmanager
def _line_named(path: Path, number: int) -> Iterator[None]:
    """Have what is wrong with a line say where it is."""
    try:
        yield
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else error
        accepted = "must be the log of a hardware trial: mend it, or give another log"
        raise LogError(f"{path}, line {number}: {reason}; {accepted}") from error


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")


def _evaluation(row: Mapping[str, Any], transducers: int, points: int) -> Evaluation:
    """The evaluation of a line, after checking it as what was asked for and read."""
    datetime.fromisoformat(row["time"])
    drive = validate_single_drive(torch.view_as_complex(real_tensor("drive", row["drive"])), transducers)
    pressure = real_tensor("pressure", row["pressure"], "Pa")
    if pressure.shape != (points,) or pressure.min() < 0:
        raise invalid("pressure", row["pressure"], f"must be {points} numbers >= 0", "Pa")
    return Evaluation(row["time"], drive, pressure, not_negative("seconds_on", row["seconds_on"], "s"))
