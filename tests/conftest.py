"""Every test carries the marker named like its folder, so that ``pytest -m physics`` runs
``tests/physics``."""

from pathlib import Path

import pytest

TESTS = Path(__file__).parent


@pytest.fixture(autouse=True)
def nothing_from_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests simulate, whatever matrices the user keeps."""
    monkeypatch.delenv("AUTDTORCH_CACHE_DIR", raising=False)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        item.add_marker(item.path.relative_to(TESTS).parts[0])
