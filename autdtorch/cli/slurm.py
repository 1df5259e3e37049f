"""The jobs of a sweep in Slurm's queue.

submitit asks `sacct` for them, which answers only on clusters that keep accounts. Elsewhere every question
leaves two warnings, and a job that was killed is awaited for ever. `squeue` answers on every cluster.
"""

from __future__ import annotations

import logging
import subprocess
import time

from submitit.slurm.slurm import SlurmInfoWatcher, SlurmJob

logger = logging.getLogger(__name__)

_PAUSE = 1.0, 10.0  # [s] between the first questions to the queue, and at most; clusters want few
_LONGER = 1.2  # growth of the pause
_MOST_FAILURES = 30  # failures of squeue in a row, some 4 min; a controller that restarts is back before


class QueueWatcher(SlurmInfoWatcher):
    """Tells submitit when the jobs have left the queue, and the user why they wait there."""

    def __init__(self, logs: str) -> None:
        """Watch no job yet; `logs` is the folder of the log of a job, with "%j" for its number."""
        super().__init__()
        self._logs = logs
        self._numbers: set[str] = set()
        self._queued = True
        self._next_question, self._pause = 0.0, _PAUSE[0]
        self._told = ""
        self._failures = 0

    def register_job(self, job_id: str) -> None:
        """Watch a job, such as "7", or "7_0" of the array 7."""
        number = job_id.partition("_")[0]
        if number not in self._numbers:
            self._numbers.add(number)
            logs = self._logs.replace("%j", f"{number}*")
            stay = f"Ctrl-C leaves it running, scancel {number} ends it"
            logger.info("Slurm job %s, logs in %s; %s", number, logs, stay)

    def is_done(self, job_id: str, mode: str = "standard") -> bool:
        """Return whether all jobs have left the queue.

        submitit asks for a job without a result, and gives up the sweep if that job has ended. A job that was
        killed is therefore not done before the others.
        """
        if time.monotonic() >= self._next_question:
            self._next_question = time.monotonic() + self._pause
            self._pause = min(_LONGER * self._pause, _PAUSE[1])
            self._ask()
        return not self._queued

    def get_state(self, job_id: str, mode: str = "standard") -> str:
        """Return whether jobs are in the queue, for submitit's messages."""
        return "in the queue" if self._queued else "ended"

    def _ask(self) -> None:
        command = ["squeue", "--me", "--noheader", "--format=%F|%T|%r"]
        try:
            answer = subprocess.run(command, capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            reason = " ".join((getattr(error, "stderr", None) or str(error)).split())
            self._failures += 1
            if self._failures >= _MOST_FAILURES:
                stay = f"the jobs {', '.join(sorted(self._numbers))} may still run"
                again = (
                    "when squeue answers and they have ended, the same command repeats what is not finished"
                )
                failed = f"squeue: {reason}, {self._failures} times in a row"
                raise ChildProcessError(f"{failed}; {stay}; {again}") from error
            self._tell(f"squeue: {reason}; asking again")
            return
        self._failures = 0
        jobs = [line.split("|", maxsplit=2) for line in answer.stdout.splitlines()]
        ours = [(state, reason) for number, state, reason in jobs if number in self._numbers]
        self._queued = bool(ours)
        reasons = {reason for state, reason in ours if state == "PENDING"} - {"None", ""}
        if reasons:
            self._tell(f"jobs wait in the queue: {', '.join(sorted(reasons))}")

    def _tell(self, line: str) -> None:
        """Log a line, unless it is the last one again."""
        if line != self._told:
            logger.info(line)
            self._told = line


def watch_queue(logs: str) -> None:
    """Have submitit ask the queue for all jobs that it submits from now on; `logs` as in `QueueWatcher`."""
    SlurmJob.watcher = QueueWatcher(logs)
