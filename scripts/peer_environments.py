"""A virtual environment for each peer: their dependencies exclude one another's."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

PACKAGES: dict[str, tuple[str, ...]] = {
    "deepwave": ("torch==2.13.0", "numpy==2.4.6", "deepwave==0.1.0"),
    "devito": ("devito==4.8.23",),
    "jwave": ("jwave==0.2.1", "jax==0.4.38"),
    "kwave": ("k-wave-python==0.6.2",),
}

PROGRAMS = Path(__file__).parent / "peers"


def python_of(peer: str, folder: Path) -> Path:
    """The interpreter of a peer's environment in `folder`, made if there is none with these packages.

    Raises:
        subprocess.CalledProcessError: it cannot be made.
    """
    environment = folder / peer
    python, done = environment / "bin" / "python", environment / "installed.txt"
    wanted = "\n".join(PACKAGES[peer])
    if not done.exists() or done.read_text(encoding="utf-8") != wanted:
        print(f"{peer}: installing {', '.join(PACKAGES[peer])} in {environment}", flush=True)
        for command in (
            [sys.executable, "-m", "venv", "--clear", str(environment)],
            [str(python), "-m", "pip", "install", "--quiet", *PACKAGES[peer]],
        ):
            subprocess.run(command, check=True, capture_output=True, text=True)
        done.write_text(wanted, encoding="utf-8")
    return python


def run(peer: str, folder: Path, task: Path, answer: Path) -> None:
    """Let a peer answer a task.

    Raises:
        subprocess.CalledProcessError: it fails.
    """
    command = [str(python_of(peer, folder)), str(PROGRAMS / f"{peer}_peer.py"), str(task), str(answer)]
    subprocess.run(command, check=True, capture_output=True, text=True)
