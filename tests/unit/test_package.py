"""The package as a whole: cost of the import, and content of a wheel. `make lint` checks its layers."""

import json
import runpy
import subprocess
import sys
import tomllib
import types
import zipfile
from pathlib import Path

import pytest
from build_hook import PythonCheck

import autdtorch as at

ROOT = Path(__file__).parents[2]
HEAVY = ("pyvista", "botorch", "gpytorch", "usb", "hydra", "numba", "matplotlib")

IMPORT = """
import json, sys, time, warnings
start = time.perf_counter()
import autdtorch
seconds = time.perf_counter() - start
heavy = set(HEAVY)
after_import = sorted(heavy & sys.modules.keys())
plots = [name for name in autdtorch.__all__ if name.startswith("plot_")]
for name in autdtorch.__all__:
    if name not in (*plots, "FocusProblem", "PhasorKernel"):  # classes of BoTorch's
        getattr(autdtorch, name)
for name in autdtorch.hardware.__all__:
    if not name.startswith("Emulated"):
        getattr(autdtorch.hardware, name)
import autdtorch.methods.catalogue
after_names = sorted(heavy & sys.modules.keys())
for name in plots:
    getattr(autdtorch, name)
after_plots = sorted(heavy & sys.modules.keys())
warnings.simplefilter("error")
autdtorch.PhasorKernel, autdtorch.FocusProblem
print(json.dumps([seconds, after_import, after_names, after_plots]))
"""


def test_imports_are_quick_without_heavy_packages_and_bring_no_warning() -> None:
    code = IMPORT.replace("HEAVY", repr(HEAVY))
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    seconds, *loaded = json.loads(child.stdout)
    # It takes some 30 ms; importing torch, which it must not, takes seconds on a loaded machine.
    assert seconds < 2.0
    assert loaded == [[], [], ["matplotlib"]]  # after the import, after all names but plots, after plots


def test_an_older_python_is_told_the_version_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    metadata = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    hook = PythonCheck(str(ROOT), {})
    hook.update(metadata)
    oldest = metadata["requires-python"].removeprefix(">=")
    major, minor = map(int, oldest.split("."))
    older = (major, minor - 1, 99)
    monkeypatch.setattr("platform.python_version", lambda: ".".join(map(str, older)))
    with pytest.raises(SystemExit, match=oldest):
        hook.update(metadata)
    monkeypatch.setattr(sys, "version_info", older)
    with pytest.raises(ImportError, match=oldest):  # in a clone
        runpy.run_path(str(ROOT / "autdtorch/__init__.py"))
    assert f"sys.version_info < ({major}, {minor})" in (ROOT / "Makefile").read_text(encoding="utf-8")


def test_no_public_name_is_that_of_a_module() -> None:
    """Otherwise lazy_loader would replace the package's type, and pickle in joblib's workers would fail."""
    assert type(at) is types.ModuleType


def test_public_names_are_listed_once_and_sorted() -> None:
    stub = (ROOT / "autdtorch/__init__.pyi").read_text(encoding="utf-8")
    listed = stub.split("__all__ = [")[1].split("]")[0].replace('"', "").replace(",", "").split()
    assert sorted(listed) == sorted(set(listed)) == sorted(at.__all__)


def test_wheel_holds_configs_stub_and_type_marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from hatchling.build import build_wheel

    monkeypatch.chdir(ROOT)
    wheel = build_wheel(str(tmp_path))
    assert wheel == f"autdtorch-{at.__version__}-py3-none-any.whl"
    with zipfile.ZipFile(tmp_path / wheel) as archive:
        names = set(archive.namelist())
        entry_points = archive.read(f"autdtorch-{at.__version__}.dist-info/entry_points.txt").decode()
    wanted = {f"autdtorch/{path.relative_to(ROOT)}" for path in (ROOT / "configs").rglob("*.yaml")}
    assert wanted
    templates = {f"autdtorch/study/report/templates/{name}" for name in ("study.md", "page.html")}
    assert wanted | templates | {"autdtorch/__init__.pyi", "autdtorch/py.typed"} <= names
    assert not any(name.startswith(("configs/", "tests/")) for name in names)
    assert "autdtorch = autdtorch.cli.main:main" in entry_points
