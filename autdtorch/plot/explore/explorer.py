"""The explorer: a live view of a scene in a notebook or a browser."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from concurrent.futures import Executor, Future
from html import escape
from pathlib import Path
from typing import Any, TypeVar

import torch
from trame.ui.html import DivLayout
from trame.widgets import rca
from trame_rca.utils import RcaRenderScheduler, RcaViewAdapter

from autdtorch.plot.explore.controls import Controls, Mouse
from autdtorch.plot.explore.page import page
from autdtorch.plot.explore.server import Defer, End, Server
from autdtorch.plot.explore.session import FIRST_METHOD, Session
from autdtorch.plot.explore.situation import Situation, checked_drive, in_phase
from autdtorch.plot.explore.trial_pictures import TrialPictures
from autdtorch.propagators.plan import plan
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import ArrayLike, require_kind

T = TypeVar("T")

_HEIGHT = 1200  # pixels of the frame in a notebook
_FRAMES = 30.0  # a second, at most
_QUALITY = {"interactive_quality": 75, "still_quality": 90}  # of JPEG; the second frame comes at rest


class Explorer:
    """A live view of a scene, as `explore` returns it. A notebook shows it in a frame.

    It ends with `close` or when it is garbage-collected. Until the first search has ended, all transducers
    are in phase.

    Attributes:
        address: address of the page, with the token that opens it; for browsers on this machine.
    """

    def __init__(
        self, scene: Scene, drive: torch.Tensor | None, spacing: float, port: int, trial: Path | None
    ) -> None:
        """Use `explore`, which checks its arguments."""
        self._spacing = spacing
        self._application = application = _Application(scene, drive, spacing, trial)
        self._server = Server(application.build, port)
        self.address = self._server.address
        # On garbage collection or at exit: OpenGL must end in its thread, before the interpreter does
        self._end = weakref.finalize(self, self._server.close)

    @property
    def scene(self) -> Scene:
        """The present scene.

        Another one may be assigned. The drive stays if the array is equal; for another array, gradient ascent
        searches one.
        """
        return self._application.session.now.scene

    @scene.setter
    def scene(self, scene: Scene) -> None:
        require_kind("scene", scene, Scene)
        plan(scene, spacing=self._spacing)  # refuses a scene too fine for the spacing
        self._server.call(lambda: self._application.session.show(scene))

    @property
    def drive(self) -> torch.Tensor:
        """The present drive (M,). Another one may be assigned, |q| <= 1; that ends a search."""
        return self._application.session.now.drive.clone()

    @drive.setter
    def drive(self, drive: ArrayLike) -> None:
        checked = checked_drive(drive, self.scene)
        self._server.call(lambda: self._application.session.play(checked))

    def ready(self) -> None:
        """Wait until the drive (if one is searched), the field and its error are calculated.

        A notebook that runs all its cells needs this before it uses `drive`.

        Raises:
            RuntimeError: the view is closed.
            Exception: the error that ended the calculation; the page shows it too.
        """
        self._server.require_running()
        session = self._application.session
        while not session.ready.wait(0.2):  # in steps that let Ctrl+C interrupt
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
        return f"Explorer(scene {self.scene.name!r}, {self.address})"

    def _repr_html_(self) -> str:
        title = escape(f"autdtorch explore: {self.scene.name}", quote=True)
        size = f'width="100%" height="{_HEIGHT}" style="border: 0"'
        return f'<iframe src="{escape(self.address)}" title="{title}" {size}></iframe>'


class _AtOnce(Executor):
    """An executor that works in the calling thread; at exit, pools of threads end before views do."""

    def submit(self, function: Callable[..., T], /, *arguments: Any, **options: Any) -> Future[T]:
        future: Future[T] = Future()
        future.set_result(function(*arguments, **options))
        return future


class _Application:
    """The application of a live view on trame's server, in the thread of the server."""

    session: Session

    def __init__(self, scene: Scene, drive: torch.Tensor | None, spacing: float, trial: Path | None) -> None:
        """Prepare the application; without a drive, a search begins."""
        self._situation = Situation.of(scene, in_phase(scene) if drive is None else drive)
        self._method = FIRST_METHOD if drive is None else None
        self._spacing = spacing
        self._pictures = None if trial is None else TrialPictures(trial)

    def build(self, trame: Any, defer: Defer) -> End:
        """Make the application; return the function that ends it."""
        self.session = session = Session(trame, self._situation, self._spacing, defer, self._pictures)
        Controls(trame, session)
        Mouse(session)
        session.begin(self._method)
        view = rca.RemoteControlledArea(
            name="view", display="image", event_throttle_ms=30, trame_server=trame
        )
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
