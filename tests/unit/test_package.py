"""The package: cost of the import, content of a wheel, docstrings with shapes and units."""

import functools
import graphlib
import inspect
import json
import re
import runpy
import subprocess
import sys
import tomllib
import types
import zipfile
from pathlib import Path

import grimp
import pytest
from build_hook import PythonCheck

import autdtorch
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


def test_no_modules_import_one_another() -> None:
    graph = grimp.build_graph("autdtorch", cache_dir=None)  # imports in functions and for types count
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    graphlib.TopologicalSorter(imports).prepare()  # raises `CycleError`, which lists a circle


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


def test_public_names_are_listed_once_sorted_and_of_no_module() -> None:
    """Otherwise lazy_loader would replace the package's type, and pickle in joblib's workers would fail."""
    assert type(at) is types.ModuleType
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
    assert "autdtorch = autdtorch.__main__:main" in entry_points


LENGTHS = (
    "center control_points corners distance domain focus half_extents height lower margin offset origin "
    "pitch points positions radius size sources spacing thickness upper vertices wavelength"
)
PRESSURES = (
    "G field loudest mean min plane_pressure pressure reference silence std threshold transfer_matrix volume"
)
UNITS = {
    "deg C": "temperature",
    "%": "relative_humidity",
    "Hz": "frequency",
    "dB": "isosurface snr",
    "dB/m": "absorption",
    "kg/m^3": "density",
    "m": LENGTHS,
    "m/s": "sound_speed",
    "m^2": "area cell_area",
    "Np/m": "attenuation",
    "Pa": PRESSURES,
    "Pa m": "source_strength",
    "rad": "angle phase phase_offsets phases rotation",
    "rad/m": "complex_wavenumber wavenumber",
    "rad/s": "angular_frequency",
    "bytes": "memory",
    "s": "seconds seconds_in_a_row seconds_on settle time_step timeout",
    "s/division": "time_scale",
    "V": "dc_offset resolution volts",
    "V/Pa": "sensitivity",
    "V/division": "finest scales",
}
UNIT_OF = {name: unit for unit, names in UNITS.items() for name in names.split()}

ARRAY = re.compile(r"Tensor|ArrayLike|NDArray|Vector")
ARRAYS = re.compile(rf"^(?!Callable|Mapping).*({ARRAY.pattern})")
SHAPE = re.compile(r"\((\.\.\.|\w+,)[^()]*\)|shape")
QUANTITY = re.compile(rf"^(?!Callable|Mapping).*\b(float|complex|{ARRAY.pattern})\b")


def public_members():
    """Yield functions and classes of ``__all__``, also of public submodules, and members of classes."""
    submodules = [thing for name in autdtorch.__all__ if inspect.ismodule(thing := getattr(autdtorch, name))]
    for module in (autdtorch, *submodules):
        for name in module.__all__:
            thing = getattr(module, name)
            if inspect.isfunction(thing):
                yield name, thing
            elif inspect.isclass(thing):
                yield name, thing
                inherited = {key for base in thing.__mro__[1:] for key in vars(base)} - {"__init__"}
                for key, member in vars(thing).items():
                    if key in inherited:
                        continue  # documented in the base class
                    function = inspect.unwrap(getattr(member, "__func__", member))
                    if key[0] != "_" or (key in ("__init__", "__call__") and function.__doc__):
                        yield f"{name}.{key}", function


@functools.cache
def members():
    return dict(public_members())


def written(thing):
    """Return the docstring of a thing with those that it refers to."""
    doc = inspect.getdoc(thing) or ""
    for other in re.findall(r"(?:see|as for) `([\w.]+)`", doc):
        doc += f"\n\n{inspect.getdoc(members().get(other))}"
    return doc


def entries(doc, title):
    """Return the texts of the entries of a section by name."""
    section = re.search(rf"^{title}:\n((?:    .*\n|\n)+)", f"{doc}\n", re.M)
    return dict(re.findall(r"^    (\w+): (.*\n(?:      .*\n|\n)*)", section[1] if section else "", re.M))


def described(thing):
    """Yield names, annotations and descriptions of parameters, results, properties and attributes."""
    doc = written(thing)
    if isinstance(thing, property):
        yield thing.fget.__name__, thing.fget.__annotations__["return"], doc
    elif inspect.isclass(thing):
        kinds = [kind for kind in thing.__mro__ if kind.__module__.startswith("autdtorch")]
        texts = {
            key: text for kind in kinds[::-1] for key, text in entries(written(kind), "Attributes").items()
        }
        for kind in kinds:
            for name, annotation in kind.__annotations__.items():
                if name[0] != "_":
                    yield name, annotation, texts.get(name, "")
    elif inspect.isfunction(thing):
        texts = entries(doc, "Args")
        signature = inspect.signature(thing)
        for name, parameter in signature.parameters.items():
            yield name, parameter.annotation, texts.get(name, doc)
        yield "return", signature.return_annotation, doc


def test_docstrings_give_shapes_and_units():
    wrong = []
    for name, member in members().items():
        for part, annotation, text in described(member):
            if ARRAYS.search(str(annotation)) and not SHAPE.search(text):
                wrong.append(f"{name}, {part}: no shape in {text!r}")
            if QUANTITY.search(str(annotation)) and part in UNIT_OF and f"[{UNIT_OF[part]}]" not in text:
                wrong.append(f"{name}, {part}: no [{UNIT_OF[part]}] in {text!r}")
    assert not wrong
