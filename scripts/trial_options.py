"""The command line of a hardware trial."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NoReturn

from trial_bench import EMULATED, MAKERS, SENSORS, device_name
from trial_run import METHODS
from trial_values import ABOVE_ZERO, COUNT, DECIBELS, NOT_NEGATIVE, SEED, SHARE, chip, indices, network

from autdtorch.hardware import DEVICES, Limits
from autdtorch.hardware.link import SETTLE

_DESCRIPTION = """\
Runs a method on a device, or on its emulator; an interrupted trial goes on with the same command.

  python scripts/hardware_trial.py --device emulated --method gabs --amplitude-limit 1
  python scripts/hardware_trial.py @my_bench.txt --method gabs --amplitude-limit 1

@FILE stands for the options that a file holds, as on the command line, in any number of lines; what follows #
is a comment."""


class Parser(argparse.ArgumentParser):
    """Errors are one line; options may come from a file."""

    def error(self, message: str) -> NoReturn:
        """End the script."""
        self.exit(2, f"hardware_trial: {message}; --help lists the options\n")

    def expanded(self, words: Sequence[str]) -> Iterator[str]:
        """`words`, with those in a file, as a shell would read them, in the place of its @FILE."""
        for word in words:
            if not word.startswith("@"):
                yield word
                continue
            try:
                yield from shlex.split(Path(word[1:]).read_text("utf-8"), comments=True)
            except (OSError, ValueError) as error:
                reason = getattr(error, "strerror", None) or error
                self.error(f"{word}: {reason}; must be a text file of options")


def parsed(words: Sequence[str]) -> argparse.Namespace:
    """The options that `words` say; `command` is how to say them without a file.

    Raises:
        SystemExit: after one line on stderr, where they are refused.
    """
    parser = Parser(
        prog="hardware_trial.py",
        usage="%(prog)s [@FILE] --device D --method M --amplitude-limit X [...]",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    _add_trial(parser)
    _add_limits(parser)
    _add_device(parser)
    _add_sensor(parser)
    expanded = list(parser.expanded(words))
    # What is still None was not given.
    options = parser.parse_args(expanded, argparse.Namespace(**dict.fromkeys(_BELONGS)))
    options.command = shlex.join(["python", "scripts/hardware_trial.py", *expanded])
    for name, (bench, belongs) in _BELONGS.items():
        if getattr(options, name) is None:
            setattr(options, name, parser.get_default(name))
        elif not belongs(options):
            parser.error(f"--{name.replace('_', '-')}: only for {bench}")
    return options


def _add_trial(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("trial").add_argument
    add(
        "--scene",
        default="three_cubes",
        help="a YAML file, or one of configs/scene by its name (%(default)s)",
    )
    add("--method", required=True, choices=list(METHODS))
    add("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings of the method, as levels=8")
    add(
        "--seed", type=SEED, default=0, metavar="N", help="of the method, and of emulated noise (%(default)s)"
    )
    add("--output", type=Path, metavar="FOLDER", help="of log, drive, report (outputs/hardware_SCENE_METHOD)")
    add("--dry-run", action="store_true", help="show the frames of an emulated trial; open no device")


def _add_limits(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("limits").add_argument
    add(
        "--amplitude-limit",
        required=True,
        type=SHARE,
        metavar="X",
        help="the most that a transducer is driven at, of 1",
    )
    add("--max-evaluations", type=COUNT, default=Limits.evaluations, metavar="N", help="in all (%(default)s)")
    add(
        "--max-seconds",
        type=ABOVE_ZERO,
        default=Limits.seconds,
        metavar="S",
        help="that the outputs are on in all (%(default)g)",
    )
    add(
        "--max-seconds-in-a-row",
        type=ABOVE_ZERO,
        default=Limits.seconds_in_a_row,
        metavar="S",
        help="that they are on without a rest (%(default)g)",
    )
    add(
        "--duty-cycle",
        type=SHARE,
        default=Limits.duty_cycle,
        metavar="X",
        help="share of the time that they are on (%(default)g)",
    )


def _add_device(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("device").add_argument
    add(
        "--device",
        required=True,
        metavar="D",
        choices=[*DEVICES, *EMULATED],
        help=f"{', '.join(DEVICES)}; emulated:NAME is its emulator, `emulated` that of a SonicSurface",
    )
    add(
        "--transducers",
        type=indices,
        metavar="I",
        help="which of the device's, counted from 0, the scene's are, as 102-105,118-121",
    )
    add("--boards", nargs="+", metavar="B", help="number of them; of OpenMPD, their .pat files")
    add("--serial", metavar="TEXT", help="number of its USB chip, where several are plugged in")
    add(
        "--network",
        type=network,
        metavar="NET",
        help="of AUTD3: interface for UDP (the one that finds the boards), or server:PORT of the kit's "
        "server on this machine",
    )
    add(
        "--settle",
        type=NOT_NEGATIVE,
        default=SETTLE,
        metavar="S",
        help="how long a drive plays before the sensor reads (%(default)g)",
    )
    add(
        "--snr",
        type=DECIBELS,
        metavar="DB",
        help="of an emulated reading, or a scope's sample; without it, no noise",
    )
    add(
        "--dead",
        type=indices,
        default=[],
        metavar="I",
        help="transducers of the emulated scene that are silent",
    )


def _add_sensor(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("sensor").add_argument
    add("--sensor", choices=SENSORS, help="by default emulated, on an emulated device")
    add("--readings-file", metavar="FILE", help="of `file`: where another program writes each reading [Pa]")
    add("--scope-chip", type=chip, metavar="VID:PID", help="of `scope`: as lsusb shows it, 2a8d:1770")
    add("--scope-maker", choices=list(MAKERS), default="keysight", help="of `scope` (%(default)s)")
    add(
        "--sensitivity",
        type=ABOVE_ZERO,
        default=0.01,
        metavar="X",
        help="of `scope`: with the amplifier (%(default)s V/Pa)",
    )
    add(
        "--loudest",
        type=ABOVE_ZERO,
        default=20.0,
        metavar="PA",
        help="of `scope`: that the inputs must take (%(default)s)",
    )
    add("--captures", type=COUNT, default=1, metavar="N", help="of `scope`: to average over (%(default)s)")
    add("--moved", action="store_true", help="of `scope`: one microphone, moved from point to point")


def _is_real(options: argparse.Namespace) -> bool:
    return options.device not in EMULATED


def _is_played_in_emulated_air(options: argparse.Namespace) -> bool:
    return options.dry_run or not _is_real(options)


def _has_a_scope(options: argparse.Namespace) -> bool:
    return bool(options.sensor == "scope")


#: By option: what it is for alone, and whether that is what the other options say.
_BELONGS: dict[str, tuple[str, Callable[[argparse.Namespace], bool]]] = {
    "boards": ("openmpd, ultraino and autd3", lambda options: device_name(options) != "sonicsurface"),
    "serial": ("a real device on USB", lambda options: _is_real(options) and options.device != "autd3"),
    "network": ("--device autd3", lambda options: options.device == "autd3"),
    "snr": (
        "emulated microphones",
        lambda options: _is_played_in_emulated_air(options) and options.sensor not in ("file", "manual"),
    ),
    "dead": ("an emulated device", _is_played_in_emulated_air),
    "readings_file": ("--sensor file", lambda options: options.sensor == "file"),
    "scope_chip": ("--sensor scope", _has_a_scope),
    "moved": (
        "--sensor scope beside a real device",
        lambda options: _is_real(options) and _has_a_scope(options),
    ),
    "scope_maker": ("--sensor scope", _has_a_scope),
    "sensitivity": ("--sensor scope", _has_a_scope),
    "loudest": ("--sensor scope", _has_a_scope),
    "captures": ("--sensor scope", _has_a_scope),
}
