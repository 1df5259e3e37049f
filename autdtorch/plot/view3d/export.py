"""Export of a 3D view to files."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from autdtorch.plot.data import MM
from autdtorch.plot.view3d.meshes import add_axes
from autdtorch.plot.view3d.still_axes import STILL_AXES
from autdtorch.scene.scene import Scene
from autdtorch.utils.files import in_folder
from autdtorch.utils.hints import with_extra
from autdtorch.utils.signals import signals_restored
from autdtorch.utils.validation import path_of

if TYPE_CHECKING:
    import pyvista

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


def export_path(name: str, value: str | Path) -> Path:
    """Return the path of a file that can be written."""
    path = path_of(name, value, suffixes=(".png", ".html", ".gltf"))
    if path.suffix.lower() == ".html" and importlib.util.find_spec("trame_pyvista") is None:
        raise RuntimeError(f"{name}: {str(path)!r} needs trame-pyvista: {with_extra('notebook')}")
    return path


def write(plotter: pyvista.Plotter, path: Path, scene: Scene, caption: Sequence[str]) -> None:
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
        add_axes(plotter, scene.domain)
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
    with signals_restored():  # trame starts a server for the page, which would ignore Ctrl-C for good
        page: str = plotter.trame.export_html(None).getvalue()
    for bar in bars.values():
        bar.SetVisibility(True)
    legend = _LEGEND.format(bars=drawn, caption="<br>".join(caption))
    path.write_text(page.replace("</body>", legend), encoding="utf-8")


def _html_bar(title: str, table: pyvista.LookupTable) -> str:
    low, high = table.scalar_range
    colours = ", ".join("rgb({}, {}, {})".format(*rgba[:3]) for rgba in table.values[::_EVERY])
    return _BAR.format(title=title, colours=colours, low=low, high=high)
