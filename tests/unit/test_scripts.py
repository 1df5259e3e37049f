"""The commands of `scripts/`, and their blocks in the documentation."""

from __future__ import annotations

import re

import pytest
from shared.document import DOCS, with_block
from shared.runner import SCRIPTS, commands

FOLDERS = {"benchmark": "benchmarks", "check": "checks", "study": "studies"}


@pytest.mark.parametrize("script", FOLDERS)
def test_every_command_has_a_summary_and_its_block_in_the_documentation(script: str) -> None:
    found = commands(FOLDERS[script])
    assert found
    for name, summary in found.items():
        assert summary.endswith(".")
        source = (SCRIPTS / FOLDERS[script] / f"{name}.py").read_text(encoding="utf-8")
        for document in re.findall(r'^DOCUMENT = "(.+)"', source, re.MULTILINE):
            with_block((DOCS / document).read_text(encoding="utf-8"), f"{script}.py {name}", "")
