"""The evaluations of a hardware trial, on disk one by one."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path

import torch


class EvaluationLog:
    """A JSON line for each evaluation: when, the drive asked for, the pressure read.

    A line is on disk before the next evaluation begins, so that the end of the process, at whatever moment,
    costs at most the evaluation in flight.
    """

    def __init__(self, path: str | Path) -> None:
        """Open the file for appending.

        Args:
            path: of the file; what it holds already stays.

        Raises:
            OSError: the file cannot be opened.
        """
        self._path = Path(path)
        self._path.open("a", encoding="utf-8").close()

    def append(self, drive: torch.Tensor, pressure: torch.Tensor) -> None:
        """Add an evaluation.

        Args:
            drive: (M,), as it was asked for.
            pressure: (P,) [Pa], as it was read.

        Raises:
            OSError: the file cannot be written.
        """
        row = {
            "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "drive": torch.view_as_real(drive).tolist(),
            "pressure": pressure.tolist(),
        }
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
            file.flush()
            os.fsync(file.fileno())
