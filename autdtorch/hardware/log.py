"""The evaluations of a hardware trial, on disk one by one, and read back."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from autdtorch.writing import naming

logger = logging.getLogger(__name__)

_ORIGIN = "origin"


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
    costs at most the evaluation in flight.

    Attributes:
        origin: what the trial is, by name.
        evaluations: what the file holds.
        goes_on: whether the file was there before.
        seconds_on: how long the outputs were on in all, as its lines say [s].
    """

    origin: dict[str, Any]
    evaluations: list[Evaluation]
    goes_on: bool
    seconds_on: float

    def __init__(self, path: str | Path, origin: Mapping[str, Any]) -> None:
        """Begin the file, or read what it holds of the same trial. A last line that broke off is removed.

        Args:
            path: of the file.
            origin: what the trial is: what JSON can hold, by name.

        Raises:
            ValueError: the file is of a trial of another origin, or no such log.
            OSError: the file cannot be read or written.
        """
        self._path = Path(path)
        self.origin = json.loads(json.dumps(origin))  # as it will be read back
        self.evaluations = []
        self.seconds_on = 0.0
        whole = _whole_lines(self._path)
        self.goes_on = bool(whole)
        if not whole:
            self._append({_ORIGIN: self.origin})
            return
        stored, self.evaluations, self.seconds_on = _parsed(self._path, whole)
        for name in sorted(stored.keys() | self.origin.keys()):
            there, here = stored.get(name), self.origin.get(name)
            if there != here:
                raise ValueError(
                    f"{self._path}: of another trial, whose {name} is {there}, not {here}; give the settings "
                    "of that trial, or another file"
                )

    def append(self, drive: torch.Tensor, pressure: torch.Tensor, seconds_on: float) -> None:
        """Add an evaluation.

        Args:
            drive: (M,), as it was asked for.
            pressure: (P,) [Pa], as it was read.
            seconds_on: how long the outputs were on so far [s].

        Raises:
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
            OSError: the file cannot be written.
        """
        self._append({"time": _now(), "seconds_on": seconds_on})
        self.seconds_on = seconds_on

    def _append(self, row: Mapping[str, Any]) -> None:
        """Add a line, or leave the file as it is: nothing may follow half a line."""
        rest = memoryview(json.dumps(row).encode() + b"\n")
        with naming(self._path), self._path.open("ab", buffering=0) as file:
            end = file.tell()
            try:
                while rest:
                    rest = rest[file.write(rest) :]
                os.fsync(file.fileno())
            except BaseException:
                file.truncate(end)
                raise


def _whole_lines(path: Path) -> list[bytes]:
    """The lines of the file, none where there is no file; what follows the last line's end is cut off."""
    if not path.exists():
        return []
    content = path.read_bytes()
    end = content.rfind(b"\n") + 1
    if end < len(content):
        logger.warning("%s: the last line broke off; its evaluation will be made again", path)
        os.truncate(path, end)
    return content[:end].splitlines()


def _parsed(path: Path, lines: list[bytes]) -> tuple[dict[str, Any], list[Evaluation], float]:
    """Origin, evaluations, and how long the outputs were on [s]."""
    try:
        first, *rows = map(json.loads, lines)
        evaluations = [_evaluation(row) for row in rows if "drive" in row]
        return dict(first[_ORIGIN]), evaluations, max((float(row["seconds_on"]) for row in rows), default=0.0)
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"{path}: {error!r}; must be the log of a hardware trial") from error


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")


def _evaluation(row: Mapping[str, Any]) -> Evaluation:
    drive = torch.view_as_complex(torch.tensor(row["drive"], dtype=torch.float64))
    pressure = torch.tensor(row["pressure"], dtype=torch.float64)
    return Evaluation(str(row["time"]), drive, pressure, float(row["seconds_on"]))
