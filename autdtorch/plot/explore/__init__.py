"""A live view of a scene, in a notebook or a browser (extra ``explore``)."""

from __future__ import annotations

import importlib.util
import os
import threading
import webbrowser
from typing import TYPE_CHECKING

from autdtorch.plot.explore.situation import checked_drive
from autdtorch.plot.view3d import require_rendering
from autdtorch.scene.scene import Scene
from autdtorch.utils.files import path_of
from autdtorch.utils.hints import with_extra
from autdtorch.utils.validation import ArrayLike, boolean, integer_at_least, invalid, positive, require_kind

if TYPE_CHECKING:
    from autdtorch.plot.explore.explorer import Explorer

_LAST_PORT = 65535
_OPENING = threading.Lock()  # one thread at a time imports PyVista and makes a trame application


def explore(
    scene: Scene,
    drive: ArrayLike | None = None,
    *,
    spacing: float = 1e-3,
    port: int = 0,
    open_browser: bool = False,
    trial: str | os.PathLike[str] | None = None,
) -> Explorer:
    """Show a scene in a live view: in a notebook, or in a browser at the view's address.

    The user moves obstacles and foci by mouse, sliders or numbers, and edits the drive or searches it by any
    method. The field is shown on a plane and in the volume: coarsely (cells twice as large) during a drag,
    then finely and with its error. Steps can be undone. Scene and drive are saved as files and as lines of
    Python. The server listens on the local interface alone, and the address includes a secret token.

    Args:
        scene: the scene.
        drive: the first drive, complex (M,), |q| <= 1; by default gradient ascent searches one.
        spacing: edge of a cell [m] when nothing is dragged; see `make_propagator`.
        port: port of the server, 0 to 65535; 0 for any free one.
        open_browser: True to open the page in this machine's browser.
        trial: folder of a hardware trial with a camera, whose newest picture is shown beside the simulated
            plane, for its drive, also while the trial runs; by default none.

    Returns:
        The live view. Its `scene` and `drive` are the present ones, and can be set; `ready` waits for the
        calculation, and `close` ends the view.

    Raises:
        ValueError: an argument is out of range, `drive` does not fit the array, or `trial` is no folder.
        ImportError: the extra ``explore`` is not installed.
        RuntimeError: this machine cannot render in 3D; the message names the cause.
        OSError: the port is taken.
    """
    require_kind("scene", scene, Scene)
    if drive is not None:
        drive = checked_drive(drive, scene)
    spacing, browses = positive("spacing", spacing, "m"), boolean("open_browser", open_browser)
    if not 0 <= (port := integer_at_least("port", port, 0)) <= _LAST_PORT:
        raise invalid("port", port, f"must be at most {_LAST_PORT}")
    folder = None if trial is None else path_of("trial", trial, "the folder of a trial")
    if folder is not None and not folder.is_dir():
        raise invalid("trial", str(trial), "must be the folder of a trial, which exists")
    if importlib.util.find_spec("trame_rca") is None:
        raise ImportError(f"explore: needs trame: {with_extra('explore')}")
    with _OPENING:
        require_rendering()
        from autdtorch.plot.explore.explorer import Explorer
        from autdtorch.propagators.plan import plan

        plan(scene, spacing=spacing)  # refuses a spacing too large for the scene, before there is a page
        explorer = Explorer(scene, drive, spacing, port, folder)
    if browses:
        webbrowser.open(explorer.address)
    return explorer
