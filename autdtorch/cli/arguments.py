"""Arguments as users type them, for Hydra's grammar, and output as terminals take it."""

from __future__ import annotations

import os
import re
import sys

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


def tolerate_any_encoding() -> None:
    """Have output replace the signs that its encoding lacks, such as those of units; a study must not end."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # not what stands for it in a test or a notebook
            stream.reconfigure(errors="replace")
