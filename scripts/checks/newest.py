"""Tests with the newest versions that pip finds, instead of those in constraints.txt.

Installs the package into a new environment in a temporary folder, prints what differs, and runs tests there.
The newest PyTorch may bring 5 GB of CUDA; `--keep torch` takes the version of constraints.txt.

    python scripts/check.py newest --keep torch -- tests/unit tests/optim
    python3.13 scripts/check.py newest                         another Python; all tests
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).parents[2]


def pins(text: str) -> dict[str, str]:
    """Return the version of each package from lines NAME==VERSION; a local version such as +cpu is cut."""
    found = re.findall(r"^([\w.-]+)==([^\s+;]+)", text, re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


def installed(python: Path, keep: list[str], folder: Path) -> dict[str, str]:
    """Install the package with its extra `dev`, and packages to keep as pinned; return all versions."""
    pinned = pins((ROOT / "constraints.txt").read_text(encoding="utf-8"))
    kept = folder / "kept.txt"
    kept.write_text("".join(f"{name}=={pinned[name]}\n" for name in keep), encoding="utf-8")
    pip = [str(python), "-m", "pip", "--disable-pip-version-check", "-qq"]
    subprocess.run([*pip, "install", "-c", str(kept), "-e", f"{ROOT}[dev]"], check=True)
    freeze = subprocess.run([*pip, "freeze"], capture_output=True, text=True, check=True)
    return pins(freeze.stdout)


OPTIONS = {
    "--keep": {"nargs": "*", "default": [], "help": "packages that stay at the version of constraints.txt"},
    "arguments": {"nargs": "*", "help": "arguments of pytest"},
}


def main(given: argparse.Namespace) -> int:
    """Install, compare and test; return the status of pytest."""
    pinned = pins((ROOT / "constraints.txt").read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        venv.create(folder / "environment", with_pip=True)
        python = folder / "environment" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
        versions = installed(python, given.keep, folder)
        newer = [
            f"{name} {versions[name]}" for name in pinned if versions.get(name, pinned[name]) != pinned[name]
        ]
        print(f"Python {sys.version.partition(' ')[0]}; unlike constraints.txt: {', '.join(newer) or 'none'}")
        command = [str(python), "-m", "pytest", "-q", "-n", "auto", "--maxprocesses", "8", *given.arguments]
        return subprocess.run(
            command, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=False
        ).returncode
