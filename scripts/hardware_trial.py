"""Run a method on a device, or on its emulator; an interrupted trial goes on with the same command.

python scripts/hardware_trial.py --device emulated --method gabs --amplitude-limit 1
"""

from __future__ import annotations

import logging
import os
import shlex
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
    options = parsed()
    trial = None
    try:
        with hardware.ended_by_signals():
            trial = Trial(options)
            trial.run(shlex.join(["python", *sys.argv]))
    except hardware.Signalled as signalled:
        goes_on = ": the outputs are off, and the same command goes on where the log ends"
        opened = trial is not None and trial.opened
        return _end(128 + signalled.number, f"{signalled}{goes_on if opened else ''}")
    except hardware.LimitError as error:
        return _end(_LIMITED, f"{error}: the outputs are off; a higher limit goes on from here")
    except (ValueError, OSError, ImportError) as error:
        return _end(_REFUSED, str(error))
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{os.path.relpath(where.filename)}, line {where.lineno}, in {where.name}"
        return _end(_FAILED, f"{type(error).__name__}: {error} ({place})")
    return 0


def _end(status: int, text: str) -> int:
    logging.error("hardware_trial: %s", "; ".join(line.strip() for line in text.splitlines()))
    return status


if __name__ == "__main__":
    sys.exit(main())
