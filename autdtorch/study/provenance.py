"""The provenance of a study: settings, seed, versions and source that its results were computed with."""

from __future__ import annotations

import platform
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import autdtorch
from autdtorch.utils.digest import digest_of, package_versions, source_digest
from autdtorch.utils.files import line_of, replace_file, row_of

PROVENANCE_FILE = "provenance.json"

_TYPES = {"config": str, "seed": int, "versions": dict, "source_digest": str, "date": str}


@dataclass(frozen=True)
class Provenance:
    """Everything that the results of a study depend on.

    Attributes:
        config: all settings, as YAML text.
        seed: of the random choices.
        versions: of autdtorch, Python, the numerical packages and the platform.
        source_digest: SHA-256 of the package's source.
        date: start of the study, UTC, ISO 8601.
    """

    config: str
    seed: int
    versions: dict[str, str]
    source_digest: str
    date: str

    @property
    def origin(self) -> str:
        """SHA-256 of all fields except the date: equal for studies with equal results."""
        return digest_of(self.config, self.seed, sorted(self.versions.items()), self.source_digest)

    def same_origin(self, other: Provenance) -> bool:
        """Return whether both studies have equal results: all fields except the date are equal."""
        return self.origin == other.origin

    def __repr__(self) -> str:
        """Return version, seed and date, without the settings."""
        return f"Provenance(autdtorch {self.versions.get('autdtorch')}, seed {self.seed}, begun {self.date})"

    @classmethod
    def from_fields(cls, fields: dict[str, Any]) -> Provenance:
        """Build from the fields read from a file, after checking their names and types."""
        if {key: type(value) for key, value in fields.items()} != _TYPES:
            accepted = ", ".join(f"{key} ({kind.__name__})" for key, kind in _TYPES.items())
            raise ValueError(f"fields {', '.join(fields)}; must be {accepted}")
        return cls(**fields)


def provenance_now(config: str, seed: int) -> Provenance:
    """Return the provenance of a study that starts now, with the source and packages of this process."""
    versions = {"autdtorch": autdtorch.__version__, "python": platform.python_version()}
    versions |= package_versions("botorch", "gpytorch") | {"platform": platform.platform()}
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return Provenance(config, seed, versions, source_digest(), date)


def save_provenance(provenance: Provenance, folder: Path) -> None:
    """Write the provenance of a study into its folder, with a checksum."""
    replace_file(folder / PROVENANCE_FILE, line_of(asdict(provenance)) + b"\n")


def load_provenance(folder: Path) -> Provenance:
    """Read the provenance that `save_provenance` wrote; refuse a damaged file or one of another version."""
    path = folder / PROVENANCE_FILE
    content = path.read_bytes()
    try:
        return Provenance.from_fields(row_of(content.removesuffix(b"\n")))
    except (ValueError, RecursionError) as error:
        accepted = f"must be a provenance file of autdtorch {autdtorch.__version__}"
        raise ValueError(f"{path}: {error}; {accepted}") from error
