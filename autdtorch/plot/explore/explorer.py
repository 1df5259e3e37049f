"""The explorer: a live view of a scene in a notebook or a browser."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable
from concurrent.futures import Executor, Future
from html import escape
from typing import Any, TypeVar

import torch
from trame.ui.html import DivLayout
from trame.widgets import rca
from trame_rca.utils import RcaRenderScheduler, RcaViewAdapter

from autdtorch.plot.explore.controls import Controls
from autdtorch.plot.explore.page import page
from autdtorch.plot.explore.server import Defer, End, Server
from autdtorch.plot.explore.session import FIRST_METHOD, Session
from autdtorch.plot.explore.situation import Situation, checked_drive, in_phase
from autdtorch.propagators.plan import plan
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import ArrayLike, require_kind

T = TypeVar("T")

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
        self._spacing = spacing
        self._shown = _Shown(Situation.of(scene, in_phase(scene) if drive is None else drive))
        first_method = FIRST_METHOD if drive is None else None
        self._server = Server(functools.partial(_build, self._shown, first_method, spacing), port)
        self.address = self._server.address
        # When nobody has it any more, or at exit: OpenGL must end in its thread, before the interpreter does
        self._end = weakref.finalize(self, self._server.close)

    @property
    def scene(self) -> Scene:
        """The scene as it is now.

        Another one may be assigned, such as the same with other obstacles. The drive stays while the array
        does; for another array, gradient ascent finds one.
        """
        return self._shown.situation.scene

    @scene.setter
    def scene(self, scene: Scene) -> None:
        require_kind("scene", scene, Scene)
        plan(scene, spacing=self._spacing)  # refuses a scene too fine for the spacing
        self._server.call(lambda: self._shown.session.show(scene))

    @property
    def drive(self) -> torch.Tensor:
        """The drive (M,) as it is now. Another one may be assigned, |q| <= 1; that ends a search."""
        return self._shown.situation.drive.clone()

    @drive.setter
    def drive(self, drive: ArrayLike) -> None:
        played = checked_drive(drive, self.scene)
        self._server.call(lambda: self._shown.session.play(played))

    def ready(self) -> None:
        """Wait until what was asked for is calculated: the drive, if one is searched, field and error.

        A notebook that runs all its cells needs this before it uses `drive`.

        Raises:
            RuntimeError: the view is closed.
            Exception: what ended the calculation, which the page shows, too.
        """
        self._server.require_running()
        session = self._shown.session
        while not session.ready.wait(0.2):  # in steps that let Ctrl+C through
            self._server.require_running()
        if session.failure is not None:
            raise session.failure

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


class _AtOnce(Executor):
    """Encodes frames in the thread that renders; a pool of threads ends before the views do, at exit."""

    def submit(self, function: Callable[..., T], /, *arguments: Any, **options: Any) -> Future[T]:
        """Call a function at once."""
        done: Future[T] = Future()
        done.set_result(function(*arguments, **options))
        return done


class _Shown:
    """The situation that is shown, and the session in the server's thread."""

    session: Session

    def __init__(self, situation: Situation) -> None:
        self.situation = situation

    def note(self, situation: Situation) -> None:
        self.situation = situation


def _build(shown: _Shown, method: str | None, spacing: float, trame: Any, defer: Defer) -> End:
    """Make the application on a trame server; return what ends it."""
    shown.session = session = Session(trame, shown.situation, spacing, defer, shown.note)
    Controls(trame, session)
    session.begin(method)
    view = rca.RemoteControlledArea(name="view", display="image", event_throttle_ms=30, trame_server=trame)
    window = session.display.picture.plotter.render_window
    scheduler = RcaRenderScheduler(window, target_fps=_FRAMES, encode_pool=_AtOnce(), **_QUALITY)
    handler = RcaViewAdapter(scheduler.rca, "view", scheduler=scheduler)
    view.add_view_handler(handler)
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
