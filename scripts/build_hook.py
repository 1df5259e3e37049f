"""Refuse to build for a Python that is too old: pip would say so only after a search for packages.

`pyproject.toml` names the file to hatchling. It runs in that Python.
"""

import platform
import sys
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface
from packaging.specifiers import SpecifierSet


class PythonCheck(MetadataHookInterface):
    """Ends the build where `requires-python` does not accept this Python."""

    def update(self, metadata: "dict[str, Any]") -> None:
        """Check the version; the metadata stay as they are."""
        needed, version = metadata["requires-python"], platform.python_version()
        if not SpecifierSet(needed).contains(version, prereleases=True):
            sys.exit(f"autdtorch needs Python {needed}, and this is Python {version}.")
