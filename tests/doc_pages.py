"""Commands and blocks of Python in README and the documentation, and a folder where they run."""

import os
import re
import shutil
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PAGES = [
    page.relative_to(ROOT).as_posix()
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md")))
]


class Command(NamedTuple):
    page: str
    text: str
    variables: str = ""  # assignments of its block


def text_of(page):
    return (ROOT / page).read_text("utf-8")


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", text_of(page), re.DOTALL | re.MULTILINE)


def listed(page):
    """Yield the commands of the page's ```sh blocks."""
    for block in blocks(page, "sh"):
        variables = ""
        for line in block.replace("\\\n", " ").splitlines():
            text = re.sub(r"(^|\s+)#\s.*$", "", line).strip()
            if re.match(r"\w+=", text):
                variables += f"{text}; "
            elif text:
                yield Command(page, text, variables)


def mentioned(page):
    """Yield commands in the text: indented, or `code` that begins like one."""
    prose = re.sub(r"^```.*?^```$", "", text_of(page), flags=re.DOTALL | re.MULTILINE)
    programs = r"(?:python scripts/|autdtorch |make |pytest |pip install )"
    for text in re.findall(rf"^    ({programs}.*)$", prose, re.MULTILINE):
        yield Command(page, re.sub(r"\s+#\s.*$", "", text))
    for text in re.findall(rf"`({programs}[^`]+)`", " ".join(prose.split())):
        if "..." not in text and "$" not in text:  # a command with something left to fill in
            yield Command(page, text)


LISTED = {page: list(listed(page)) for page in PAGES}
IN_BLOCKS = {command.text for commands in LISTED.values() for command in commands}
MENTIONED = sorted(
    {command for page in PAGES for command in mentioned(page) if command.text not in IN_BLOCKS}
)
PYTHON = {page: "\n".join(blocks(page, "python")) for page in PAGES}


def furnish(folder):
    """Make what a clone has, and the files that pages tell to write: YAML blocks that begin with `# name`."""
    shutil.copytree(ROOT / "configs", folder / "configs")
    (folder / "docs").mkdir()
    for name in ("scripts", "constraints.txt", "pyproject.toml", "Makefile"):
        (folder / name).symlink_to(ROOT / name)
    for page in PAGES:
        for block in blocks(page, "yaml"):
            if named := re.match(r"# ([\w/]+\.yaml)\b", block):
                path = folder / named[1]
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(block, "utf-8")
    # scenes, a method and a launcher of the user's own
    scene = (folder / "configs/scene/two_cubes.yaml").read_text("utf-8")
    (folder / "mine/scene/duct.yaml").write_text(scene.replace("two_cubes", "duct"), "utf-8")
    zone = folder / "mine/scene/zone.yaml"
    others = re.sub(r"^control_points:.*?(?=^\S)", "", scene, flags=re.DOTALL | re.MULTILINE)
    zone.write_text(others.replace("two_cubes", "zone") + zone.read_text("utf-8"), "utf-8")
    (climb,) = (
        cell for cell in blocks("docs/extending.md", r"\{code-cell\} ipython3") if "class HillClimb" in cell
    )
    (folder / "climbing.py").write_text(climb, "utf-8")
    launcher = folder / "cluster/hydra/launcher/mine.yaml"
    launcher.parent.mkdir(parents=True)
    shutil.copy(ROOT / "configs/hydra/launcher/slurm.yaml", launcher)
    programs = folder / "programs"
    programs.mkdir()
    for name, arguments in {"autdtorch": "-m autdtorch", "python": ""}.items():
        (programs / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {arguments} "$@"\n', "utf-8")
        (programs / name).chmod(0o755)


def environment(folder):
    return {
        **os.environ,
        "PATH": f"{folder / 'programs'}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "MPLBACKEND": "Agg",
    }


# docs/hardware.md opens devices and an oscilloscope: emulated ones take their places.
EMULATED = """
from pathlib import Path

import torch

import autdtorch as at
from autdtorch import hardware

benches, open_link, open_scope = [], hardware.open_link, hardware.open_scope


def emulated_link(device, transducers=None, **options):
    count = device.transducers if transducers is None else len(transducers)
    matrix = torch.polar(1 + torch.rand(4, count), 6 * torch.rand(4, count)).to(torch.complex128)
    benches.append(hardware.EmulatedBench(device, matrix, transducers))
    return open_link(device, transducers, backend=benches[-1].bus, **options)


def emulated_scope(chip, dialect=hardware.KEYSIGHT, backend=None):
    if backend is None:
        scope = hardware.EmulatedScope(benches[-1].pressure, 40e3, sensitivity=0.04, points=[0, 1, 2, 3])
        scope.plug_into(benches[-1], chip)
        backend = benches[-1].bus
    return open_scope(chip, dialect, backend=backend)


class Microphones:
    def __init__(self, path, points):
        pass

    def read(self):
        return hardware.EmulatedSensor(benches[-1]).read()


hardware.open_link, hardware.open_scope, hardware.FileSensor = emulated_link, emulated_scope, Microphones
for name in ("left", "right"):
    zeros, gains = " ".join(["0"] * 256), " ".join(["1"] * 256)
    places, pins = "(0, 0, 0) " * 256, " ".join(map(str, range(256)))
    Path(f"{name}.pat").write_text("\\n".join([name, "256", "128", places, pins, zeros, gains]))
"""
