"""Run tests with the newest versions that pip finds, instead of those in constraints.txt.

A new environment in a temporary folder holds the packages that are newer, over those of the environment that
runs the script, whose pip installs them. Without one, it holds all packages. Prints the differences, and runs
tests there. The newest PyTorch may bring 5 GB of CUDA; `--keep torch` takes the version of constraints.txt.

    python scripts/check.py newest --keep torch -- tests/unit tests/optim
    python3.13 scripts/check.py newest                         another Python; all tests
"""

import os
import re
import subprocess
import sys
import sysconfig
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).parents[2]
IN_ENVIRONMENT = sys.prefix != sys.base_prefix

OPTIONS = {
    "--install": {"nargs": "+", "default": [".[dev]"], "help": "what pip installs, with what that needs"},
    "--keep": {"nargs": "*", "default": [], "help": "packages that stay at the version of constraints.txt"},
    "arguments": {"nargs": "*", "help": "arguments of pytest"},
}


def main(install: list[str], keep: list[str], arguments: list[str]) -> int:
    """Install, compare and test; return the status of pytest."""
    pinned = pins((ROOT / "constraints.txt").read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        python = new_environment(folder / "environment")
        constraints = folder / "constraints.txt"
        constraints.write_text("".join(f"{name}=={pinned[name]}\n" for name in keep), encoding="utf-8")
        pip = [sys.executable, "-m", "pip", "--python", python, "--disable-pip-version-check", "-qq"]
        newest = ["install", "--no-compile", "--upgrade", "--upgrade-strategy", "eager", "-c", constraints]
        if IN_ENVIRONMENT:
            newest.append("--no-build-isolation")  # its hatchling builds
        subprocess.run([*pip, *newest, "-e", *install], cwd=ROOT, check=True)
        frozen = subprocess.run([*pip, "freeze"], capture_output=True, text=True, check=True).stdout
        versions = pins(frozen).items()  # constraints.txt need not name all
        newer = [f"{name} {version}" for name, version in versions if pinned.get(name, version) != version]
        print(f"Python {sys.version.partition(' ')[0]}; unlike constraints.txt: {', '.join(newer) or 'none'}")
        command = [python, "-m", "pytest", "-q", "-n", "auto", "--maxprocesses", "8", *arguments]
        # another Numba would take the place of the kernels that are compiled for this one
        environment = os.environ | {"PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(folder / "numba")}
        return subprocess.run(command, cwd=ROOT, env=environment).returncode


def new_environment(folder: Path) -> Path:
    """Make an environment that also sees the packages of this process; return its Python."""
    venv.create(folder)
    if IN_ENVIRONMENT:
        base = {"base": str(folder), "platbase": str(folder)}
        packages = Path(sysconfig.get_path("purelib", "venv", base))
        (packages / "zz_older.pth").write_text(f"{sysconfig.get_path('purelib')}\n", encoding="utf-8")
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def pins(text: str) -> dict[str, str]:
    """Return the version of each package from lines NAME==VERSION; a local version such as +cpu is cut."""
    lines = re.findall(r"^([\w.-]+)==([^\s+;]+)", text, re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in lines}
