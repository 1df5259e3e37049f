"""Run a method on a device, or on its emulator; an interrupted trial goes on with the same command.

python scripts/hardware_trial.py --device emulated --method gabs --amplitude-limit 1
"""

from __future__ import annotations

import logging
import os
import sys
import traceback

_FAILED, _REFUSED, _LIMITED, _INTERRUPTED = 1, 2, 3, 130


def main() -> int:
    """Run the command line; returns the status for the shell, after one line on stderr if it is not 0."""
    logging.basicConfig(format="%(message)s")
    try:
        return _run()
    except KeyboardInterrupt:  # while signals were not looked after yet
        return _end(_INTERRUPTED, "SIGINT")


def _run() -> int:
    from trial_options import parsed  # these take seconds to import
    from trial_run import Trial

    from autdtorch import hardware

    logging.getLogger().setLevel(logging.INFO)  # only now: half of PyTorch would log its caches
    options = parsed(sys.argv[1:])
    trial = None
    try:
        with hardware.ended_by_signals():
            trial = Trial(options)
            trial.run(options.command)
    except (Exception, hardware.Signalled) as error:
        status, text, then = _described(error)
        if (left_on := _left_on(error)) is not None:
            text += "" if left_on is error else f"; {left_on}"
        elif trial is not None and trial.begun:
            text += f": the outputs are off{then}"
        return _end(status, text)
    return 0


def _described(error: BaseException) -> tuple[int, str, str]:
    """Status, what happened, and how the trial goes on."""
    from autdtorch import hardware

    same = ", and the same command goes on where the log ends"
    match error:
        case hardware.Signalled():
            return 128 + error.number, str(error), same
        case hardware.LimitError():
            return _LIMITED, str(error), "; a higher limit goes on from here"
        case hardware.LogError():
            return _REFUSED, f"{error} (--output)", ""
        case ValueError() | OSError() | ImportError():
            return _REFUSED, str(error), same
        case _:
            where = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{os.path.relpath(where.filename)}, line {where.lineno}, in {where.name}"
            return _FAILED, f"{type(error).__name__}: {error} ({place})", same


def _left_on(error: BaseException | None) -> BaseException | None:
    """What says that a device may play on: that error, or one that it came after."""
    from autdtorch import hardware

    while error is not None and not isinstance(error, hardware.OffError):
        error = error.__cause__ or error.__context__
    return error


def _end(status: int, text: str) -> int:
    logging.error("hardware_trial: %s", "; ".join(line.strip() for line in text.splitlines()))
    return status


if __name__ == "__main__":
    sys.exit(main())
