"""The history of situations: undo and redo."""

from __future__ import annotations

from autdtorch.plot.explore.situation import Situation
from autdtorch.scene.obstacles import Mesh

_MOST = 200  # steps that are kept
_MOST_BYTES = 100_000_000  # of the vertices of meshes in them; all else is small, or shared


class History:
    """The situation now, and those before and after it.

    A drag passes through many situations and makes one step.

    Attributes:
        now: the situation that is shown.
    """

    def __init__(self, situation: Situation) -> None:
        """Begin at a situation."""
        self.now = situation
        self._done: list[Situation] = []
        self._undone: list[Situation] = []
        self._before: Situation | None = None

    @property
    def can_undo(self) -> bool:
        """True if there is a step to undo."""
        return bool(self._done) or self._before is not None

    @property
    def can_redo(self) -> bool:
        """True if there is a step to take again."""
        return bool(self._undone)

    def change(self, situation: Situation) -> None:
        """Show another situation; the step ends with `settle`."""
        if situation is self.now:
            return
        if self._before is None:
            self._before = self.now
        self.now = situation

    def amend(self, situation: Situation) -> None:
        """Show a situation that is now in place of that of the last step."""
        self.now = situation

    def step(self, situation: Situation) -> None:
        """Show another situation, as a step of its own."""
        self.settle()
        self.change(situation)
        self.settle()

    def settle(self) -> bool:
        """End a step; return False if none has begun."""
        if self._before is None:
            return False
        self._done = [*self._done, self._before][-_most(self.now) :]
        self._undone, self._before = [], None
        return True

    def undo(self) -> None:
        """Go back to the situation before the last step."""
        self.settle()
        if self._done:
            self._undone.append(self.now)
            self.now = self._done.pop()

    def redo(self) -> None:
        """Take a step again that was undone."""
        if self._undone:
            self._done.append(self.now)
            self.now = self._undone.pop()


def _most(situation: Situation) -> int:
    """Return the number of steps that are kept."""
    meshes = [one for one in situation.scene.obstacles if isinstance(one, Mesh)]
    size = sum(mesh.vertices.nbytes for mesh in meshes)
    return max(1, min(_MOST, _MOST_BYTES // max(size, 1)))
