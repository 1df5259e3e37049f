"""Check that this machine can render in 3D."""

from __future__ import annotations

import functools
import importlib.util
import signal
import subprocess
import sys

_PROBE = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(32, 32))
plotter.add_mesh(pyvista.Sphere())
if not plotter.screenshot(return_img=True).std():
    raise SystemExit("the rendered picture is blank")
"""
_PROBE_TIMEOUT = 120.0  # s; a first import of PyVista can take tens of seconds


@functools.cache
def rendering_problem() -> str | None:
    """Return why this machine cannot render in 3D, or None if it can; checked once per process.

    A child process makes the check: without an OpenGL driver, VTK raises no error but ends the process.
    """
    try:
        command = [sys.executable, "-c", _PROBE]
        child = subprocess.run(command, capture_output=True, text=True, timeout=_PROBE_TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        cause = f"a trial rendering did not end within {_PROBE_TIMEOUT:g} s"
    else:
        if child.returncode == 0:
            return None
        lines = child.stderr.strip().splitlines() or [f"exit status {child.returncode}"]
        cause = f"a trial rendering failed with {lines[-1].strip()!r}"
        if child.returncode < 0:
            cause = f"a trial rendering was killed by {signal.Signals(-child.returncode).name}"
    return (
        f"3D rendering is not available: {cause}. It needs an OpenGL driver, on Debian the packages libegl1 "
        "libgl1-mesa-dri libosmesa6"
    )


def require_rendering() -> None:
    """Check that rendering is safe, and import Triton if it is installed.

    Triton contains an LLVM. If it is imported after Mesa's software driver, which loads another LLVM, the
    process ends. PyTorch's optimisers import Triton, so it is imported here first.
    """
    if problem := rendering_problem():
        raise RuntimeError(problem)
    if importlib.util.find_spec("triton") is not None:
        importlib.import_module("triton")
