"""Scenes and fields in 3D with PyVista (optional extra ``viz``): rendered off-screen, exported and animated.

Lengths are in mm.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import json
import math
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor

from autdtorch.plot import meshes3d, plotter3d
from autdtorch.plot.colours import FLOOR, FOCUS_COLOUR, WAVE_MAP
from autdtorch.plot.data import MM, in_decibels, largest, legible_unit, pressure_text, zero_level
from autdtorch.plot.plotter3d import STILL_AXES
from autdtorch.scene.scene import Scene
from autdtorch.utils.files import in_folder, path_of
from autdtorch.utils.hints import with_extra
from autdtorch.utils.process import signals_restored
from autdtorch.utils.validation import (
    ArrayLike,
    boolean,
    complex_tensor,
    integer_at_least,
    number_between,
    require_kind,
)

if TYPE_CHECKING:
    import pyvista

_PROBE = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(32, 32))
plotter.add_mesh(pyvista.Sphere())
if not plotter.screenshot(return_img=True).std():
    raise SystemExit("the rendered picture is blank")
"""
_PROBE_TIMEOUT = 120.0  # s; a first import of PyVista can take tens of seconds


class RenderingError(RuntimeError, ImportError):
    """This machine cannot render in 3D, since it lacks a driver; the message names what to install.

    So it is an `ImportError` too, as of a missing package: the command line ends with the message alone.
    """


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
    """Raise a `RenderingError` unless rendering is safe, and import Triton if it is installed.

    Triton contains an LLVM. If it is imported after Mesa's software driver, which loads another LLVM, the
    process ends. PyTorch's optimisers import Triton, so it is imported here first.
    """
    if problem := rendering_problem():
        raise RenderingError(problem)
    if importlib.util.find_spec("triton") is not None:
        importlib.import_module("triton")


_FRAME_TIME = 80  # ms; GIF counts hundredths of a second

_GREYS, _SHADES = 24, 8  # of 256 colours: for lines and obstacles, and for control points

# The viewer takes the element of class "content"; without one it would empty the whole page.
_LEGEND = """<div class="content"></div>
<div style="position: fixed; z-index: 1; left: 16px; top: 16px; display: flex; gap: 32px;
 font: 14px sans-serif">{bars}<div>{caption}</div></div>
</body>"""
_BAR = """<div>{title}<div
 style="width: 200px; height: 14px; background: linear-gradient(to right, {colours})"></div><div
 style="display: flex; justify-content: space-between"><span>{low:g}</span><span>{high:g}</span></div>
</div>"""
_EVERY = 8  # every 8th colour of a table makes the gradient
_WASM = "trame.widgets.vtklocal"


def view3d(
    scene: Scene,
    drive: ArrayLike | None = None,
    field: ArrayLike | None = None,
    volume: ArrayLike | None = None,
    *,
    isosurface: float = -3.0,
    reference: float | None = None,
    save: str | Path | None = None,
    off_screen: bool = True,
) -> pyvista.Plotter:
    """Render transducers, obstacles, reflectors, control points, plane and field, in millimetres.

    Pressures outside the obstacles are shown as levels 20 lg(|p| / reference) from -30 to 0 dB. A caption
    gives the reference.

    Args:
        scene: scene to draw.
        drive: complex (M,); colours the transducers by phase. Silent transducers are grey.
        field: pressure on the observation plane (Nu, Nv) [Pa], complex or its magnitude, at the points of
            `Plane.points`; colours the plane. Without it, the plane is translucent.
        volume: pressure in the domain (Nx, Ny, Nz) [Pa], complex or its magnitude, from `volume_field`; NaN
            where unknown. It is shown as an isosurface.
        isosurface: level of the isosurface [dB], in -30 to 0.
        reference: the pressure of 0 dB [Pa], > 0; by default the largest of `field` or, without it, of
            `volume`. Pictures with equal references can be compared.
        save: file to write, ``.png``, ``.html`` (interactive; extra ``notebook``) or ``.gltf`` (for other 3D
            programs, in m, without axes and colour bars).
        off_screen: False for a plotter whose ``show()`` opens a window.

    Returns:
        The plotter, for changes or ``show()``; close it when done.

    Raises:
        ImportError: HTML is asked for, and the extra ``notebook`` is not installed.
        RuntimeError: this machine cannot render; the message names the cause.
        ValueError: `drive`, `field` or `volume` does not fit the scene, or another argument is out of range.
    """
    require_kind("scene", scene, Scene)
    off_screen = boolean("off_screen", off_screen)
    phases = None if drive is None else meshes3d.emitted_phases(drive, len(scene.array))
    on_plane = None if field is None else meshes3d.plane_pressure(scene, field)[1]
    in_domain = None if volume is None else meshes3d.volume_magnitude(scene, volume)
    height = number_between("isosurface", isosurface, FLOOR, 0.0, "dB")
    name, shown = ("volume", in_domain) if on_plane is None else ("field", on_plane)
    zero = zero_level(reference, name, np.ones(1) if shown is None else shown)
    path = None if save is None else _export_path("save", save)
    require_rendering()
    plotter = meshes3d.new_plotter(scene, off_screen, (drive is not None, shown is not None))
    meshes3d.add_transducers(plotter, scene, phases)
    if scene.observation_plane is not None:
        level = None if on_plane is None else in_decibels(on_plane, zero)
        meshes3d.add_plane(plotter, scene.observation_plane, level)
    caption = [] if on_plane is None and in_domain is None else [f"0 dB = {pressure_text(zero)}"]
    if in_domain is not None:
        meshes3d.add_isosurface(plotter, scene, in_decibels(in_domain, zero), height)
        caption.append(f"surface: {height:g} dB")
    plotter3d.add_caption(plotter, *caption)
    if path is not None:
        _write(plotter, path, scene, caption)
    return plotter


def animate3d(
    scene: Scene, drive: ArrayLike, field: ArrayLike, path: str | Path, *, frames: int = 24
) -> None:
    """Write a GIF of the instantaneous pressure Re(p e^{-i w t}) on the observation plane over one period.

    The colours of the transducers are their phases phi + w t. The GIF repeats without a jump. The pressure
    inside obstacles is not shown.

    Args:
        scene: scene to draw.
        drive: complex (M,).
        field: complex pressure on the observation plane (Nu, Nv) [Pa], at the points of `Plane.points`.
        path: file to write, ``.gif``.
        frames: number of frames in the period, >= 2.

    Raises:
        RuntimeError: this machine cannot render; the message names the cause.
        ValueError: `drive` or `field` does not fit the scene, `field` is a magnitude, `path` has another
            suffix, or `frames` is less than 2.
    """
    require_kind("scene", scene, Scene)
    phases = meshes3d.emitted_phases(drive, len(scene.array))
    plane, magnitude = meshes3d.plane_pressure(scene, field)
    pressure = complex_tensor("field", field).detach().cpu().numpy()
    unit, size = legible_unit(largest(magnitude))
    pressure[np.isnan(magnitude)] = math.nan
    pressure /= size
    frames = integer_at_least("frames", frames, 2)
    path = path_of("path", path, suffixes=(".gif",))
    require_rendering()
    plotter = meshes3d.new_plotter(scene, off_screen=True, bars=(True, True))
    discs = meshes3d.add_transducers(plotter, scene, phases)
    sheet = meshes3d.plane_mesh(plane, pressure.real)
    peak = largest(magnitude) / size
    digit = 10.0 ** math.floor(math.log10(peak)) if peak else 1.0
    limit = digit * max(1, math.ceil(peak / digit))  # of one digit, for round numbers on the colour bar
    actor = meshes3d.add_sheet(plotter, sheet, WAVE_MAP, (-limit, limit))
    plotter3d.add_bar(plotter, actor, f"p(t) [{unit}]", position=plotter3d.FIELD_BAR, labels=5, fmt="%.3g")
    plotter3d.add_caption(plotter, f"one period: {1e6 / scene.frequency:.3g} µs")
    emitted = discs["phase"].copy()
    pictures = []
    for turn in np.arange(frames) / frames:
        discs["phase"] = (emitted + 2 * turn) % 2
        sheet.copy_from(meshes3d.plane_mesh(plane, (pressure * np.exp(-2j * math.pi * turn)).real))
        plotter.render()
        pictures.append(Image.fromarray(plotter.screenshot(return_img=True)))
    colours = _colours(plotter)
    plotter.close()
    palette = Image.new("P", (1, 1))
    palette.putpalette(colours.tobytes())
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first.save(in_folder(path), save_all=True, append_images=others, duration=_FRAME_TIME, loop=0)


def _colours(plotter: pyvista.Plotter) -> NDArray[np.uint8]:
    """Return one palette (256, 3) for all frames: with different palettes, static parts would flicker."""
    tables = [np.asarray(bar.lookup_table.values)[:, :3] for bar in plotter.scalar_bars.values()]
    greys = np.linspace(0, 255, _GREYS)[:, None] * np.ones(3)
    shades = np.linspace(0.3, 1.0, _SHADES)[:, None] * np.array(ImageColor.getrgb(FOCUS_COLOUR))
    each = (256 - _GREYS - _SHADES) // len(tables)
    maps = [table[np.linspace(0, len(table) - 1, each).astype(int)] for table in tables]
    return np.concatenate([greys, shades, *maps]).astype(np.uint8)


def _export_path(name: str, value: str | Path) -> Path:
    """Return the path of a file that can be written."""
    path = path_of(name, value, suffixes=(".png", ".html", ".gltf"))
    if path.suffix.lower() == ".html" and importlib.util.find_spec("trame_pyvista") is None:
        raise ImportError(f"{name}: {str(path)!r} needs trame-pyvista: {with_extra('notebook')}")
    return path


def _write(plotter: pyvista.Plotter, path: Path, scene: Scene, caption: Sequence[str]) -> None:
    """Write the view in the format of the path's suffix."""
    in_folder(path)
    if path.suffix.lower() == ".png":
        Image.fromarray(plotter.screenshot(return_img=True)).save(path)
        return
    still = [actor for name, actor in plotter.actors.items() if name.startswith(STILL_AXES)]
    for actor in still:  # axes of a picture, in which the view does not turn
        actor.SetVisibility(False)
    if path.suffix.lower() == ".gltf":
        _write_gltf(plotter, path)
    else:
        plotter3d.add_axes(plotter, scene.domain)
        _write_html(plotter, path, caption)
        plotter.remove_bounds_axes()
    for actor in still:
        actor.SetVisibility(True)


def _write_gltf(plotter: pyvista.Plotter, path: Path) -> None:
    """Write glTF in metres, without the camera, which PyVista does not turn with the scene.

    The materials are corrected: VTK tints textures and makes translucent surfaces opaque.
    """
    plotter.export_gltf(str(path))
    content = json.loads(path.read_text(encoding="utf-8"))
    del content["cameras"]
    for node in content["nodes"]:
        node.pop("camera", None)
        if "children" in node:
            node["scale"] = [1 / MM] * 3
    for material in content["materials"]:
        surface = material["pbrMetallicRoughness"]
        if "baseColorTexture" in surface:
            surface["baseColorFactor"][:3] = 1.0, 1.0, 1.0
        if surface["baseColorFactor"][3] < 1:
            material["alphaMode"] = "BLEND"
        material["doubleSided"] = True
    path.write_text(json.dumps(content), encoding="utf-8")


def _write_html(plotter: pyvista.Plotter, path: Path, caption: Sequence[str]) -> None:
    """Write HTML with separate colour bars: the viewer in the page would draw all of them in one place."""
    bars = plotter.scalar_bars
    drawn = "".join(_html_bar(title.strip(), bar.lookup_table) for title, bar in bars.items())
    for bar in bars.values():
        bar.SetVisibility(False)
    with signals_restored(), _without_wasm():  # trame starts a server for the page, which ignores Ctrl-C
        page: str = plotter.trame.export_html(None).getvalue()
    for bar in bars.values():
        bar.SetVisibility(True)
    legend = _LEGEND.format(bars=drawn, caption="<br>".join(caption))
    path.write_text(page.replace("</body>", legend), encoding="utf-8")


@contextlib.contextmanager
def _without_wasm() -> Iterator[None]:
    """Hide a package from trame that would download VTK for browsers, which the page does not need."""
    if _WASM in sys.modules:
        yield
        return
    sys.modules[_WASM] = None  # type: ignore[assignment] # stands for a missing module
    try:
        yield
    finally:
        del sys.modules[_WASM]


def _html_bar(title: str, table: pyvista.LookupTable) -> str:
    low, high = table.scalar_range
    colours = ", ".join("rgb({}, {}, {})".format(*rgba[:3]) for rgba in table.values[::_EVERY])
    return _BAR.format(title=title, colours=colours, low=low, high=high)
