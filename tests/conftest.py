"""Every test carries the marker named like its folder, so that ``pytest -m physics`` runs
``tests/physics``. Where there is no GPU, Triton interprets the CUDA kernel on the CPU."""

import os
from pathlib import Path

import pytest
import torch

TESTS = Path(__file__).parent

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when Triton's functions are defined


@pytest.fixture(autouse=True)
def nothing_from_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests simulate, whatever matrices the user keeps."""
    monkeypatch.delenv("AUTDTORCH_CACHE_DIR", raising=False)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        item.add_marker(item.path.relative_to(TESTS).parts[0])
