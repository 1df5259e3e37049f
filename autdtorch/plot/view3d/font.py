"""The font of 3D views: that of Matplotlib's figures, because VTK's fonts have no π."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib import get_data_path

if TYPE_CHECKING:
    from vtkmodules.vtkRenderingCore import vtkTextProperty

FONT_FILE = str(Path(get_data_path()) / "fonts/ttf/DejaVuSans.ttf")
_FROM_FILE = 4  # VTK_FONT_FILE


def use_font(*properties: vtkTextProperty) -> None:
    """Use the font of Matplotlib's figures."""
    for text in properties:
        text.SetFontFamily(_FROM_FILE)
        text.SetFontFile(FONT_FILE)
