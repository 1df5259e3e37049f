"""The history of situations: undo and redo."""

from __future__ import annotations

from autdtorch.plot.explore.situation import Situation

_MOST = 200  # steps that are kept; a situation shares almost all with the one before


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
        if self._before is None:
            self._before = self.now
        self.now = situation

    def settle(self) -> None:
        """End a step, if one has begun."""
        if self._before is not None:
            self._done = [*self._done, self._before][-_MOST:]
            self._undone, self._before = [], None

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
