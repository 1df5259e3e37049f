"""A sequence on a device: a focus that moves along the path of a config, or the frames of a file."""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig

from autdtorch import hardware
from autdtorch.cli.configured_bench import Bench
from autdtorch.cli.errors import in_one_line
from autdtorch.cli.hardware_command import note_outputs
from autdtorch.cli.settings import (
    folder_of,
    given_file,
    is_given,
    require_effective,
    scene_of,
    section_of,
    solver_of,
)
from autdtorch.io.drive_file import load_sequence, save_sequence
from autdtorch.methods.holography.sequence import sequence_along
from autdtorch.objectives.objective import SimulatedObjective
from autdtorch.propagators import Propagator, make_propagator
from autdtorch.scene.geometry import circle_points, plane_basis, polyline_points
from autdtorch.scene.scene import Scene
from autdtorch.scene.sequence import LONGEST, Sequence, modulated
from autdtorch.utils.array_types import REAL
from autdtorch.utils.digest import digest_of
from autdtorch.utils.validation import (
    boolean,
    finite_vector,
    invalid,
    positive,
    require_known,
    require_one_of,
    unit_vector,
    within,
)

_EFFECTIVE = re.compile(r"\+*(scene|modules|solver|path|play|hardware|output|hydra)\b")
_EFFECTIVE_WITH_FILE = re.compile(r"(?!\+*path\b)")
_KEYS = ("rate", "modulation", "sequence", "seconds")
_MODULATION = ("frequency", "depth", "waveform", "rate")


def play(settings: dict[str, Any], modules: list[Any], output: Any) -> None:
    """Play the sequence of the settings; leave it in a folder, with a note of how it was played.

    Every error carries a note on whether the outputs are off.

    Raises:
        ValueError: a setting that is unknown, out of range or without effect here, or a sequence that the
            device cannot play.
        LimitError: a limit of the outputs is reached.
        LinkError: the device is missing, or does not take the bytes.
    """
    require_effective("play", _EFFECTIVE, "scene, path, hardware, play.KEY, solver.KEY or output")
    section = section_of(settings, "play")
    require_known("play", section, _KEYS)
    if settings.get("hardware") is None:
        raise invalid("hardware", None, "must be a device, such as hardware=emulated")
    scene = scene_of("scene", section_of(settings, "scene"), modules)
    bench = Bench(section_of(settings, "hardware"), scene, settings.get("seed", 0), has_sensor=False)
    seconds = None if section["seconds"] is None else positive("play.seconds", section["seconds"], "s")
    folder = Path("outputs") / f"play_{HydraConfig.get().runtime.choices['scene']}"
    folder = folder_of("output", output) if is_given("output") else folder
    propagator = make_propagator(scene, **solver_of(settings))
    sequence = _sequence(section, section_of(settings, "path"), scene, bench, propagator)
    if not (sequence.loop or is_given("play.seconds")):
        seconds = None  # all frames once
    if bench.is_emulated:
        bench.emulate(SimulatedObjective(scene, propagator), propagator)
    folder.mkdir(parents=True, exist_ok=True)
    save_sequence(folder / "sequence.npz", sequence, scene.array)
    playback = _played(bench, sequence, seconds, folder / "play.jsonl")
    print(f"{playback}\nThe sequence is in {shlex.quote(os.path.relpath(folder / 'sequence.npz'))}")


def _sequence(
    section: dict[str, Any], path: dict[str, Any], scene: Scene, bench: Bench, propagator: Propagator
) -> Sequence:
    rate = positive("play.rate", section["rate"], "Hz")
    if (file := given_file("play.sequence", section["sequence"])) is not None:
        require_effective("a file of play.sequence", _EFFECTIVE_WITH_FILE, "path or play.sequence")
        with within("play.sequence"):
            sequence = load_sequence(file, rate if is_given("play.rate") else None)
        if is_given("play.rate"):
            sequence = sequence.at_rate(rate)
    else:
        bench.device.require_rate(rate)
        points = path_points("path", path, scene, rate)
        sequence = sequence_along(propagator, points, rate / len(points), loop=path.get("closed", True))
    if (modulation := section["modulation"]) is None:
        return sequence
    if not isinstance(modulation, dict):
        raise invalid("play.modulation", modulation, "must be a mapping, such as {frequency: 200}")
    require_known("play.modulation", modulation, _MODULATION)
    with within("play.modulation"):
        sequence = modulated(sequence, **{"frequency": None, "rate": None, **modulation})
        bench.device.require_rate(sequence.rate)
    return sequence


def _played(bench: Bench, sequence: Sequence, seconds: float | None, log: Path) -> hardware.Playback:
    """Play a sequence within the limits, and add a line on it to a log; return its times."""
    begun = False
    row: dict[str, Any] = {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": bench.device.name,
        "emulated": bench.is_emulated,
        "transducers": bench.transducers,
        "amplitude limit": bench.limits.amplitude,
        **bench.device.settings,
        "sequence": digest_of(sequence.drives)[:16],
        "frames": len(sequence),
        "rate [Hz]": sequence.rate,
    }
    try:
        with hardware.ended_by_signals(), bench.link() as link:
            begun = not bench.is_dry
            playback = hardware.LimitedLink(link, bench.limits).play_sequence(sequence, seconds)
    except (Exception, KeyboardInterrupt) as error:
        note_outputs(error, begun)
        row["error"] = in_one_line(error)
        raise
    else:
        row["played"] = asdict(playback)
        return playback
    finally:
        with log.open("a", encoding="utf-8") as lines:
            lines.write(f"{json.dumps(row)}\n")


def path_points(where: str, section: Mapping[str, Any], scene: Scene, rate: float) -> torch.Tensor:
    """Return the points of a lap of the path of a section such as ``{type: circle, radius: 5e-3}``.

    Args:
        where: name of the section in messages.
        section: `type`, `frequency` [Hz] of laps, and the settings of the type. Without a place the path is
            around the middle of the control points, across the direction of the first transducer.
        scene: the scene.
        rate: points per second [Hz]; the frequency is rounded to a whole number of points a lap.

    Returns:
        Points (T, 3) [m].

    Raises:
        ValueError: an unknown type or setting, or a setting out of range.
    """
    kind = section.get("type")
    require_one_of(f"{where}.type", kind, _KINDS)
    keys, points = _KINDS[str(kind)]
    require_known(where, section, ("type", "frequency", *keys))
    frequency = positive(f"{where}.frequency", section.get("frequency"), "Hz")
    if not rate / LONGEST <= frequency <= rate / 2:
        accepted = f"must be in {rate / LONGEST:g} to {rate / 2:g}, for {LONGEST} to 2 points a lap"
        raise invalid(f"{where}.frequency", frequency, accepted, "Hz")
    with within(where):
        return points(scene, round(rate / frequency), *(section.get(key) for key in keys))


def _circle(scene: Scene, count: int, center: Any, radius: Any, normal: Any) -> torch.Tensor:
    across = scene.array.normals[0] if normal is None else normal
    return circle_points(_center(scene, center), radius, count, across)


def _line(scene: Scene, count: int, center: Any, length: Any, direction: Any) -> torch.Tensor:
    along = plane_basis(scene.array.normals[0])[0]
    if direction is not None:
        along = torch.tensor(unit_vector("direction", direction), **REAL)
    half = positive("length", length, "m") / 2 * along
    middle = _center(scene, center)
    return polyline_points(torch.stack([middle - half, middle + half]), count)


def _lines(scene: Scene, count: int, positions: Any, closed: Any) -> torch.Tensor:
    if positions is None:
        raise invalid("positions", None, "must be given, as [[0, 0, 0.1], [0, 0.01, 0.1]]")
    return polyline_points(positions, count, boolean("closed", closed))


def _center(scene: Scene, center: Any) -> torch.Tensor:
    if center is None:
        return scene.control_points.mean(dim=0)
    return torch.tensor(finite_vector("center", center), **REAL)


_KINDS: dict[str, tuple[tuple[str, ...], Callable[..., torch.Tensor]]] = {
    "circle": (("center", "radius", "normal"), _circle),
    "line": (("center", "length", "direction"), _line),
    "points": (("positions", "closed"), _lines),
}
