"""One-line errors: what the command line prints, and the status it ends with."""

from __future__ import annotations

import os
import re
import signal
import sys
import traceback
from typing import NoReturn

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException

from autdtorch import hardware

FULL_ERROR = "HYDRA_FULL_ERROR"
"""Environment variable that asks for tracebacks."""

AGAIN = "the same command repeats what is not finished"

_REFUSALS = (ValueError, OSError, ImportError, HydraException, OmegaConfBaseException)

_NO_SLURM = 'Could not detect "srun"'  # submitit, on a machine without Slurm
# Names of submitit's errors, since it may be missing; and a job that ended without reporting its own.
_SUBMITIT_ERRORS = ("FailedJobError", "UncompletedJobError")
_LOST_JOB = re.compile(r" (/.*/(\d[\d_]*))/\2_\d+_(?:result\.pkl|log\.err)$", re.MULTILINE)


class FailedJob(Exception):
    """Tells Hydra that a job of a sweep failed."""


def stop(error: BaseException) -> NoReturn:
    """Print an error in one line on stderr, and end with its status.

    The status is 2 where a setting is refused or a file cannot be written, and 3 where a limit of a hardware
    trial is reached. After a signal it is 128 and its number, and 1 after any other error, such as one in a
    user's own method.
    """
    print(f"autdtorch: {in_one_line(error)}", file=sys.stderr)
    if isinstance(error, KeyboardInterrupt):
        sys.exit(128 + getattr(error, "number", signal.SIGINT))  # as a shell reports it
    if _is_refusal(error):
        sys.exit(2)
    sys.exit(3 if isinstance(error, hardware.LimitError) else 1)  # which is imported when it is asked for


def in_one_line(error: BaseException) -> str:
    """Return the message of an error, with its notes, in one line."""
    return "; ".join([_message(error), *getattr(error, "__notes__", [])])


def _is_refusal(error: BaseException) -> bool:
    of_submitit = type(error).__name__ in _SUBMITIT_ERRORS or _NO_SLURM in str(error)
    return of_submitit or isinstance(error, (FailedJob, *_REFUSALS))


def _message(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return str(error) or "interrupted; finished trials are kept, and the same command goes on after them"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    text = str(error)
    if not (_is_refusal(error) or isinstance(error, hardware.LimitError)):
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{os.path.relpath(where.filename)}, line {where.lineno}, in {where.name}"
        text = f"{type(error).__name__}: {text} ({place}); {FULL_ERROR}=1 shows the traceback"
    if lost := _LOST_JOB.search(text):
        return f"job {lost[2]} ended without results; its log is in {os.path.relpath(lost[1])}; {AGAIN}"
    return _of_hydra(error, text)


def _of_hydra(error: BaseException, text: str) -> str:
    """Return a message of Hydra in our words; others as they are, in one line."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = error.missing_cfg_file.rpartition("/")
        more = "; pip install 'autdtorch[cluster]' brings more, hydra.searchpath=[FOLDER] your own"
        more = more if group == "hydra/launcher" else ""
        return f"{group}: {name!r}; must be one of {', '.join(error.options)}{more}"
    # Hydra would advise to add the key, which we would then refuse.
    if unknown := re.match(r"Could not override '(.+)'", text):
        key = getattr(error.__cause__, "full_key", None) or unknown[1]
        return f"{key}: unknown key; autdtorch --cfg job lists the settings"
    if found := re.match(r"(Error merging override [^,\n]+)", text):
        text = f"{found[1]}: {error.__cause__}"
    if missing := re.match(r"Missing mandatory value: (\S+)", text):
        return f"{missing[1]}: none; must be given, as {missing[1]}=VALUE"
    if "missing EQUAL" in text and (word := re.search(r"'(.*?)'", text)):
        return f"{word[1]}: must be key=value, such as scene=three_cubes; autdtorch --help lists the settings"
    if isinstance(error, OverrideParseException):
        why = text.partition("\n")[0]
        accepted = "must be KEY=VALUE, a value with signs in quotes: 'KEY=\"a=b\"'"
        return f"argument {error.override!r}: {why}; {accepted}"
    lines = [line.strip() for line in text.splitlines()]
    return "; ".join(line for line in lines if line and not line.startswith("See https://"))
