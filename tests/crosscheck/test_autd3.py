"""Our free-space fields and levels against the emulator of the AUTD3 SDK."""

from __future__ import annotations

import math

import pytest
import torch

for package in ("autd3_emulator", "autd3_pattern"):
    pytest.importorskip(package, reason="needs the SDK's emulator: install autdtorch[crosscheck]")

from crosscheck_autd3 import (
    SPACING,
)
