"""One-line errors: what the command line prints, and the status it ends with."""

from __future__ import annotations

import os
import re
import signal
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from autdtorch import hardware
from autdtorch.cli.arguments import COMMANDS
from autdtorch.cli.config_files import GROUPS
from autdtorch.io.yaml_file import TARGET
from autdtorch.utils.hints import did_you_mean, nearest_name, with_extra

FULL_ERROR = "HYDRA_FULL_ERROR"
"""Environment variable that asks for tracebacks."""

AGAIN = "the same command repeats what is not finished"

_REFUSALS = (ValueError, OSError, ImportError, HydraException, OmegaConfBaseException)

_CUT_OFF = 128 + 13  # as a shell reports SIGPIPE, which Windows lacks

_NO_SLURM = 'Could not detect "srun"'  # submitit, on a machine without Slurm
# Names of submitit's errors, since it may be missing; and a job that ended without a report of its error.
_SUBMITIT_ERRORS = ("FailedJobError", "UncompletedJobError")
_LOST_JOB = re.compile(r" (/.*/(\d[\d_]*))/\2_\d+_(?:result\.pkl|log\.err)$", re.MULTILINE)


class FailedJob(Exception):
    """Tells Hydra that a job of a sweep failed."""


def stop(error: BaseException) -> NoReturn:
    """Print an error in one line on stderr, and end with its status.

    The status is 2 where a setting is refused or a file cannot be written, and 3 where a limit of a hardware
    trial is reached. After a signal it is 128 and its number, and 1 after any other error, such as one in a
    user's method. Where the reader of the output has ended, as `head` does, nothing is printed.
    """
    if isinstance(error, BrokenPipeError) and _is_cut_off():
        sys.exit(_CUT_OFF)
    print(f"autdtorch: {in_one_line(error)}", file=sys.stderr)
    if isinstance(error, KeyboardInterrupt):
        sys.exit(128 + getattr(error, "number", signal.SIGINT))  # as a shell reports it
    if _is_refusal(error):
        sys.exit(2)
    sys.exit(3 if isinstance(error, hardware.LimitError) else 1)  # which is imported when it is asked for


def _is_cut_off() -> bool:
    """Return whether nobody reads stdout any more; what is left for it then leads nowhere."""
    try:
        print(flush=True)  # an empty line, as a pipe shows its end to a writer alone
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - to the end
        return True
    return False


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


def _of_missing(group: str, name: str, options: Sequence[str]) -> str:
    """Return the message of a config that is not there, such as "two_cube" of the group "scene"."""
    path = Path(name)
    if path.suffix in (".yaml", ".yml") or len(path.parts) > 1:
        stem, folder = path.stem, path.parent.parent if path.parent.name == group else Path("FOLDER")
        ours = f"{group}={stem}"
        # Hydra's groups may hold shell commands and are not read from --config-dir.
        option = "hydra.searchpath=[{}]" if group.startswith("hydra/") else "--config-dir {}"
        mine = (
            f"a file of your own is FOLDER/{group}/NAME.yaml, given as {option.format('FOLDER')} {group}=NAME"
        )
        if stem not in options:
            ours = f"{option.format(folder)} {group}={stem}"
        return f"{group}: {name!r}; must be a name, not a path: {ours}; {mine}"
    more = f"; the extra cluster brings more ({with_extra('cluster')}), hydra.searchpath=[FOLDER] your own"
    more = more if group == "hydra/launcher" else ""
    return f"{group}: {name!r}; must be one of {', '.join(options)}{did_you_mean(name, options)}{more}"


def _siblings(error: BaseException | None) -> list[str]:
    """Return the settings that are there, where an error of OmegaConf is about one that is not."""
    parent = getattr(error, "parent_node", None)
    return [str(key) for key in parent if key != TARGET] if isinstance(parent, DictConfig) else []


def _in_groups(error: BaseException | None, key: str) -> list[str]:
    """Return the settings of the groups that end in a key, where an error of OmegaConf is about it."""
    parent = getattr(error, "parent_node", None)
    groups = parent.items_ex(resolve=False) if isinstance(parent, DictConfig) else ()
    return [f"{group!s}.{key}" for group, each in groups if isinstance(each, DictConfig) and key in each]


def _of_hydra(error: BaseException, text: str) -> str:
    """Return a message of Hydra in our words; others as they are, in one line."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        available = re.search(r"Available options in '(.+)'", text)
        group = available[1] if available else error.missing_cfg_file.rpartition("/")[0]
        return _of_missing(group, error.missing_cfg_file.removeprefix(f"{group}/"), error.options)
    if unknown := re.match(r"Could not override '(.+)'", text):
        key = str(getattr(error.__cause__, "full_key", None) or unknown[1])
        if key in GROUPS:  # which this config lacks
            return f"{unknown[1]}: there is no {key}; must be chosen, as {key}=NAME"
        keys = _siblings(error.__cause__)
        parent, _, name = key.rpartition(".")
        alike = nearest_name(name, keys if parent else [*keys, *GROUPS])
        elsewhere = _in_groups(error.__cause__, unknown[1].rpartition(".")[2])
        if alike and "." in unknown[1]:
            elsewhere = []
        hints = [repr(hint) for hint in (*elsewhere[:1], alike) if hint]
        hint = f" (did you mean {' or '.join(hints)}?)" if hints else ""
        listed = ""
        if "." in key:  # others are all set, and Hydra's advice to add one would then be refused
            added = re.search(r"To append to your config use (\+.+)", text)
            listed += f"; keys that are set: {', '.join(keys)}" if keys else ""
            listed += f"; a key that the file leaves out is added as {added[1]}" if added else ""
        return f"{key}: unknown key{hint}{listed}; autdtorch --cfg job lists the settings"
    if merging := re.match(r"(Error merging override [^,\n]+)", text):
        text = f"{merging[1]}: {error.__cause__}"
        key = merging[1].removeprefix("Error merging override ").partition("=")[0]
        if "list index out of range" in text:
            return f"{key}: a list has no item of this number; autdtorch --cfg job lists the settings"
        if "Cannot merge" in text:
            return f"{key}: a list in place of a mapping, or the reverse; ~{key} +{key}=VALUE replaces it"
    if missing := re.match(r"Missing mandatory value: (\S+)", text):
        return f"{missing[1]}: none; must be given, as {missing[1]}=VALUE"
    if "missing EQUAL" in text and (word := re.search(r"'(.*?)'", text)):
        accepted = "must be key=value, such as scene=three_cubes"
        hint = did_you_mean(word[1], COMMANDS)
        return f"{word[1]}: {accepted}{hint}; autdtorch --help lists the settings"
    if isinstance(error, OverrideParseException):
        why = text.partition("\n")[0]
        accepted = "must be KEY=VALUE, a value with signs in quotes: 'KEY=\"a=b\"'"
        if re.match(r"[^=]*\[\d+\\?\]", error.override or ""):
            accepted = "an item of a list has its number between dots: scene.obstacles.0.density=1.5"
        elif re.search(r"=\{.*(?<!\\)\[\d+\]\S*:", error.override or ""):
            accepted = r"in {...}, brackets of a name have backslashes, as in {obstacles\[0\].x: 2e-3}"
        return f"argument {error.override!r}: {why}; {accepted}"
    lines = [line.strip() for line in text.splitlines()]
    return "; ".join(line for line in lines if line and not line.startswith("See https://"))
