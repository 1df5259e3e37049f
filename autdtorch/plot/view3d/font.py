"""The font of 3D views. It is Matplotlib's, because the fonts of VTK have no π."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vtkmodules.vtkRenderingCore import vtkTextProperty

_FROM_FILE = 4  # VTK_FONT_FILE


def font_file() -> str:
    """Return the path of the font."""
    from matplotlib import get_data_path

    return str(Path(get_data_path()) / "fonts/ttf/DejaVuSans.ttf")


def use_font(*properties: vtkTextProperty) -> None:
    """Use the font for texts."""
    for text in properties:
        text.SetFontFamily(_FROM_FILE)
        text.SetFontFile(font_file())
