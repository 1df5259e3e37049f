"""The command `autdtorch`, also ``python -m autdtorch``: loads PyTorch while Hydra is imported."""

import ctypes
import os
import sys
import threading
from importlib.util import find_spec
from pathlib import Path


def main() -> None:
    """Run the command line."""
    if not any(word.startswith("-") for word in sys.argv[1:]):  # most options print and end
        _load_torch_library()
    from autdtorch.cli.main import main

    main()


def _load_torch_library() -> None:
    """Load PyTorch's largest library in a thread, 0.3 s, in which Hydra is imported and composes.

    Python waits for the thread before it ends: a library that loads at exit crashes, as its destructors run.
    """
    spec = find_spec("torch")
    if sys.platform == "linux" and spec is not None and spec.origin is not None:
        library = Path(spec.origin).with_name("lib") / "libtorch_cpu.so"
        dlopen = ctypes.CDLL(None).dlopen  # without the interpreter lock, which ctypes.CDLL(library) holds
        threading.Thread(target=dlopen, args=(bytes(library), os.RTLD_NOW)).start()


if __name__ == "__main__":
    main()
