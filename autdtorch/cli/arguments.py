"""Arguments as users type them, for Hydra's grammar, and standard streams that take any output."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from typing import NoReturn

from hydra._internal.utils import get_args_parser

from autdtorch.utils.hints import did_you_mean, with_extra

COMMANDS = ("explore", "calibrate", "collect", "play")
"""Words that stand for another command than a study, anywhere among the arguments."""

_SWEEP = re.compile(r"\+*hydra\.mode=(RunMode\.)?MULTIRUN")  # as -m
_LAUNCHER = re.compile(r"\+*hydra/launcher=(slurm|submitit_\w+|joblib)")
_OPTIONS = {
    option: action.nargs is None  # whether a word follows
    for action in get_args_parser()._actions
    for option in action.option_strings
}

_LAST_STANDARD = 2  # number of the last of the standard streams: input, output, errors
_PATH = re.compile(r"(output|hydra\.sweep\.dir)=(?P<path>.*)", re.DOTALL)
# Paths that stay as they are: plain characters, text in quotes, interpolations, several values of a sweep,
# and text with =, which is rather a slip than part of a name
_TAKEN = re.compile(r"[A-Za-z0-9_./\\:@%+ -]*|.*=.*|['\"].*|.*\$\{.*|.*,.*", re.DOTALL)


def quoted(argument: str) -> str:
    """Return an argument with its path in quotes, where Hydra's grammar needs them, and with ~ expanded."""
    setting = _PATH.fullmatch(argument)
    if setting is None or _TAKEN.fullmatch(setting["path"]):
        return argument
    path = re.sub(r"(\\*)'", r"\1\1\\'", os.path.expanduser(setting["path"]))
    return f"{setting[1]}='{path}'"


def command_of(arguments: list[str]) -> str | None:
    """Remove the word of a command from the arguments, wherever it stands, and return it."""
    for place, word in enumerate(arguments):
        if word in COMMANDS and not (place and _OPTIONS.get(arguments[place - 1])):
            return arguments.pop(place)
    return None


def settings_first(arguments: Sequence[str]) -> list[str]:
    """Return arguments with the settings before all options, between which Hydra takes none."""
    options = [
        word.startswith("-") or bool(place and _OPTIONS.get(arguments[place - 1]))
        for place, word in enumerate(arguments)
    ]
    return [
        word
        for kind in (False, True)
        for word, is_option in zip(arguments, options, strict=True)
        if is_option is kind
    ]


def is_sweep(arguments: Sequence[str]) -> bool:
    """Return whether the arguments ask for a sweep.

    Refuse, in one line, options that Hydra does not have and settings that a sweep does not take.
    """
    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        dashed = [word for word in arguments if word.startswith("-")]
        wrong = next((word for word in dashed if word.partition("=")[0] not in _OPTIONS), message)
        name, _, value = wrong.lstrip("-").partition("=")
        alike = [option for option in _OPTIONS if option.startswith("--") or not wrong.startswith("--")]
        hint = did_you_mean(wrong.partition("=")[0], alike)
        accepted = f"settings have no dashes, as in {name}={value or 'VALUE'}; autdtorch --help lists them"
        raise ValueError(f"{wrong}: unknown option{hint}; {accepted}")

    parser.error = refuse  # type: ignore[method-assign]
    if "--version" in arguments:  # which prints and ends
        return False
    sweep = bool(parser.parse_args(arguments).multirun) or any(map(_SWEEP.fullmatch, arguments))
    for word in arguments:
        if launcher := _LAUNCHER.fullmatch(word):
            plugin = "joblib" if launcher[1] == "joblib" else "submitit"
            if not _has_plugin(f"hydra_{plugin}_launcher"):
                needs = f"needs the extra cluster: {with_extra('cluster')}"
                raise ValueError(f"hydra/launcher: {launcher[1]!r}; {needs}")
        if sweep and re.match(r"\+*output=", word):
            accepted = "a sweep has a folder for each job in hydra.sweep.dir"
            raise ValueError(f"{word}: {accepted}, as hydra.sweep.dir={word.partition('=')[2]}")
    return sweep


def _has_plugin(name: str) -> bool:
    try:
        return find_spec(f"hydra_plugins.{name}") is not None
    except ModuleNotFoundError:  # no plugin at all
        return False


def prepare_streams() -> None:
    """Make the standard streams accept any output, so that no study ends because of it.

    Characters that an encoding lacks, such as those of units, are replaced. Closed streams, as of a daemon or
    a program without a console, lead nowhere. Files that are opened later do not get their numbers, to which
    libraries write errors.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= _LAST_STANDARD:
        os.set_inheritable(number, True)
    os.close(number)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None or getattr(stream, "closed", False):
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - to the end
        elif hasattr(stream, "reconfigure"):  # not what stands for it in a test or a notebook
            stream.reconfigure(errors="replace")
