"""Tests under other instruction sets, thread counts, libraries and paths.

Prints the failed tests of each variant. Exits with 1 if any test failed.

    python scripts/check.py portability                        all variants, about an hour on 2 cores
    python scripts/check.py portability other-cpu -m optim     one variant, some tests: arguments of pytest
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]

COLD = "NUMBA_CACHE_DIR"
"""Variable that variants set to an empty folder."""

VARIANTS: dict[str, dict[str, str]] = {
    "aten-default": {"ATEN_CPU_CAPABILITY": "default"},
    "aten-avx2": {"ATEN_CPU_CAPABILITY": "avx2"},
    "mkl-compatible": {"MKL_CBWR": "COMPATIBLE"},
    "one-thread": {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    "openblas-haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "numba-generic": {"NUMBA_CPU_NAME": "generic", COLD: ""},
    "odd-path": {},
}
VARIANTS["other-cpu"] = {key: value for variant in VARIANTS.values() for key, value in variant.items()} | {
    "ATEN_CPU_CAPABILITY": "default"
}
"""All variants at once; CI runs this one."""


OPTIONS = {
    "variant": {"nargs": "?", "choices": [*VARIANTS, "all"], "default": "all", "help": "environment"},
    "arguments": {"nargs": argparse.REMAINDER, "help": "arguments of pytest"},
}


def main(variant: str, arguments: list[str]) -> int:
    failed = []
    for name in VARIANTS if variant == "all" else [variant]:
        begin = time.monotonic()
        settings = " ".join(f"{key}={value or '(empty)'}" for key, value in VARIANTS[name].items())
        print(f"{name}: {settings}", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            passed, summary = run(name, arguments, Path(folder))
        print(f"  {summary}; {time.monotonic() - begin:.0f} s", flush=True)
        failed += [] if passed else [name]
    if failed:
        print(f"failed: {', '.join(failed)}")
    return int(bool(failed))


def copied(folder: Path) -> Path:
    """Copy the checkout below `folder`, to a path with spaces and letters beyond ASCII."""
    place = folder / "Prüfstand 40 kHz 文"
    files = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    for name in filter(None, files.stdout.split("\0")):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, place / name)
    return place


def run(variant: str, arguments: list[str], folder: Path) -> tuple[bool, str]:
    """Run pytest under a variant; return whether all passed, and its last line."""
    environment = os.environ | VARIANTS[variant]
    if COLD in VARIANTS[variant]:
        environment[COLD] = str(folder / "numba")
    place = copied(folder) if variant == "odd-path" else ROOT
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(place), os.environ.get("PYTHONPATH"))))
    command = [sys.executable, "-m", "pytest", "-q", "-n", "auto", "--dist", "worksteal", *arguments]
    ended = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, check=False)
    lines = ended.stdout.strip().splitlines() or [ended.stderr.strip()[-500:]]
    for line in lines:
        if re.match("(FAILED|ERROR) ", line):
            print(f"  {line}", flush=True)
    return ended.returncode == 0, lines[-1].strip("= ")
