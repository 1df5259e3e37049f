"""Arguments as users type them, for Hydra's grammar, and standard streams that take any output."""

from __future__ import annotations

import os
import re
import sys

_LAST_STANDARD = 2  # number of the last of the standard streams: input, output, errors
_PATH = re.compile(r"(output|hydra\.sweep\.dir)=(?P<path>.*)", re.DOTALL)
# What Hydra takes as it is, or as a text in quotes, an interpolation, or several values of a sweep; an =
# is rather a slip than part of a name
_TAKEN = re.compile(r"[A-Za-z0-9_./\\:@%+ -]*|.*=.*|['\"].*|.*\$\{.*|.*,.*", re.DOTALL)


def quoted(argument: str) -> str:
    """Return an argument with the path in it in quotes where Hydra would not take it, and ~ replaced."""
    found = _PATH.fullmatch(argument)
    if found is None or _TAKEN.fullmatch(found["path"]):
        return argument
    path = re.sub(r"(\\*)'", r"\1\1\\'", os.path.expanduser(found["path"]))
    return f"{found[1]}='{path}'"


def prepare_streams() -> None:
    """Have the standard streams take any output, as a study must not end for it.

    Signs that an encoding lacks, such as those of units, are replaced. Streams that a daemon has closed, or
    that a program without a console never had, lead nowhere; the next file that is opened must not get their
    numbers, which libraries write errors to.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= _LAST_STANDARD:
        os.set_inheritable(number, True)
    os.close(number)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None or getattr(stream, "closed", False):
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - to the end
        elif hasattr(stream, "reconfigure"):  # not what stands for it in a test or a notebook
            stream.reconfigure(errors="replace")
