"""Progress of long work: a bar on a terminal, beside the log; elsewhere, and in workers, the log alone."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import sys
from collections.abc import Iterator

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

logger = logging.getLogger(__name__)


class Progress:
    """Counts steps, and says what is being done."""

    def __init__(self, bar: tqdm[None] | None) -> None:
        """Show it on a bar, or in the log."""
        self._bar = bar

    def begin(self, what: str) -> None:
        """Say what is being done from now on."""
        if self._bar is None:
            logger.info(what)
        else:
            self._bar.set_description(what)

    def advance(self, steps: int) -> None:
        """Count steps that are done."""
        if self._bar is not None:
            self._bar.update(steps)


@contextlib.contextmanager
def show_progress(steps: int) -> Iterator[Progress]:
    """Show the progress of so many steps."""
    if not sys.stderr.isatty() or multiprocessing.parent_process() is not None:
        yield Progress(None)
        return
    with logging_redirect_tqdm(), tqdm(total=steps, file=sys.stderr, dynamic_ncols=True) as bar:
        yield Progress(bar)
