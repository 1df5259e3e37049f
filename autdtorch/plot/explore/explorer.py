"""The explorer: a live view of a scene in a notebook or a browser."""

from __future__ import annotations

import functools
import weakref
from html import escape
from typing import Any

import torch
from trame.ui.html import DivLayout
from trame.widgets import rca

from autdtorch.plot.explore.controls import Controls
from autdtorch.plot.explore.page import page
from autdtorch.plot.explore.server import Defer, End, Server
from autdtorch.plot.explore.session import Session
from autdtorch.plot.explore.situation import Situation
from autdtorch.scene.scene import Scene

_HEIGHT = 1200  # pixels of the frame in a notebook
_FRAMES = 30.0  # a second, at most
_QUALITY = {"interactive_quality": 75, "still_quality": 90}  # of JPEG; the second frame comes at rest


class Explorer:
    """A live view of a scene, as `explore` returns it. A notebook shows it in a frame.

    It ends with `close`, or when nothing refers to it any more. Until the first drive is found, all
    transducers are in phase.

    Attributes:
        address: of the page, with the token that opens it; for browsers on this machine.
    """

    def __init__(self, scene: Scene, drive: torch.Tensor | None, spacing: float, port: int) -> None:
        """Use `explore`, which checks its arguments."""
        in_phase = torch.ones(len(scene.array), dtype=torch.complex128, device="cpu")
        self._shown = _Shown(Situation.of(scene, in_phase if drive is None else drive))
        first_method = "gradient_ascent" if drive is None else None
        self._server = Server(functools.partial(_build, self._shown, first_method, spacing), port)
        self.address = self._server.address
        # When nobody has it any more, or at exit: OpenGL must end in its thread, before the interpreter does
        self._end = weakref.finalize(self, self._server.close)

    @property
    def scene(self) -> Scene:
        """The scene as it is now."""
        return self._shown.situation.scene

    @property
    def drive(self) -> torch.Tensor:
        """The drive (M,) as it is now."""
        return self._shown.situation.drive.clone()

    def close(self) -> None:
        """End the live view."""
        self._end()

    def wait(self) -> None:
        """Wait until the live view is closed."""
        self._server.wait()

    def __repr__(self) -> str:
        """Scene and address."""
        return f"Explorer(scene {self.scene.name!r}, {self.address})"

    def _repr_html_(self) -> str:
        """Return the frame that a notebook shows."""
        title = escape(f"autdtorch explore: {self.scene.name}", quote=True)
        size = f'width="100%" height="{_HEIGHT}" style="border: 0"'
        return f'<iframe src="{escape(self.address)}" title="{title}" {size}></iframe>'


class _Shown:
    """The situation that is shown."""

    def __init__(self, situation: Situation) -> None:
        self.situation = situation

    def note(self, situation: Situation) -> None:
        self.situation = situation


def _build(shown: _Shown, method: str | None, spacing: float, trame: Any, defer: Defer) -> End:
    """Make the application on a trame server; return what ends it."""
    session = Session(trame, shown.situation, spacing, defer, shown.note)
    Controls(trame, session)
    session.begin(method)
    view = rca.RemoteControlledArea(name="view", display="image", event_throttle_ms=30, trame_server=trame)
    handler = view.create_view_handler(
        session.display.picture.plotter.render_window, encoder="jpeg", target_fps=_FRAMES,
        **_QUALITY,
    )  # fmt: skip
    session.display.update = handler.update
    layout = DivLayout(trame)  # without `with`, which would keep the server until another is made
    layout.root.classes = "explore"
    layout.root.add_child(page(view.html))
    layout.flush_content()

    async def end() -> None:
        session.close()
        await handler.close()  # before its window, which a frame would open again for ever
        session.display.picture.close()

    return end
