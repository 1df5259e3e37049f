"""The memory that is available to this process."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import psutil

from autdtorch.utils.validation import invalid

_NEGLIGIBLE = 1e6  # bytes; asking the system takes a millisecond

_CGROUP = Path("/proc/self/cgroup")
_MOUNT = Path("/sys/fs/cgroup")
# Files of a control group by version: the limit, the memory in use, and the reclaimable part of it.
_FILES_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_FILES_2 = ("memory.max", "memory.current", "inactive_file")


def available_memory() -> int:
    """Return the memory [bytes] that the machine, control groups and limits leave to this process."""
    left = [psutil.virtual_memory().available, *_left_in_groups(), *_left_to_process()]
    return int(max(0, min(left)))


def require_memory(field: str, value: object, needed: float, unit: str = "") -> None:
    """Refuse an argument that needs more memory [bytes] than is available."""
    if needed < _NEGLIGIBLE:
        return
    if needed > (available := available_memory()):
        left = f"this process may use {available / 1e9:.3g} GB"
        raise invalid(field, value, f"needs about {needed / 1e9:.3g} GB of memory, {left}", unit)


def _left_in_groups() -> Iterator[int]:
    """Yield the memory left in each control group of this process."""
    with contextlib.suppress(OSError):  # not Linux
        for line in _CGROUP.read_text("utf-8").splitlines():
            _, controllers, path = line.split(":", 2)
            if not controllers:
                root, files = _MOUNT, _FILES_2
            elif "memory" in controllers.split(","):
                root, files = _MOUNT / "memory", _FILES_1
            else:
                continue
            here = root / path.lstrip("/")
            for folder in (here, *here.parents):
                if folder.is_relative_to(root):
                    yield from _left_in_group(folder, *files)


def _left_in_group(folder: Path, limit: str, usage: str, inactive: str) -> Iterator[int]:
    # a group without a limit has no such file, or "max" in it
    with contextlib.suppress(OSError, ValueError):
        most, used = (int((folder / name).read_text("ascii")) for name in (limit, usage))
        statistics = dict(line.split() for line in (folder / "memory.stat").read_text("ascii").splitlines())
        yield most - used + int(statistics.get(inactive, 0))


def _left_to_process() -> Iterator[int]:
    """Yield the memory left below the limit of `ulimit -v`."""
    with contextlib.suppress(ImportError):  # Windows
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[0]
        if most != resource.RLIM_INFINITY:
            yield most - psutil.Process().memory_info().vms
