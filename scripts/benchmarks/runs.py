"""Time saved by symmetry between foci, and by matrices on disk.

Prints a Markdown table of the transfer matrices of the foci at 1 mm, from one run, from a run per focus, and
from disk.

    python scripts/benchmark.py runs            about 3 minutes on 2 idle cores
"""

import tempfile

import torch
from shared.document import printed, table
from shared.scenes import paper_scene, relative_error, uncached
from shared.timing import timed

import autdtorch as at

SCENES = ("three_cubes", "two_cubes", "sphere")
OPTIONS = {"--spacing": {"type": float, "default": 1.0, "help": "[mm]"}}


def main(spacing: float) -> None:
    """Print the table."""
    rows = (measure(name, method, 1e-3 * spacing) for name in SCENES for method in ("box", "full"))
    header = ["scene", "runs", "these runs", "a run per focus", "apart", "from disk"]
    print("", table(header, printed(rows)), sep="\n")


def measure(name: str, method: str, spacing: float) -> list[str]:
    """Return a row of times and the difference of the matrices."""
    scene = paper_scene(name)
    uncached(scene, method, 2.0, tolerance=0.1).transfer_matrix()  # compiles the kernel
    with tempfile.TemporaryDirectory() as folder:
        propagator = at.make_propagator(scene, method, spacing, cache=folder)
        matrix, together = timed(propagator.transfer_matrix)
        runs = len(propagator.runs)
        rows, apart = timed(
            lambda: [propagator.transfer_matrix(point[None]) for point in scene.control_points]
        )
        again, disk = timed(at.make_propagator(scene, method, spacing, cache=folder).transfer_matrix)
    assert torch.equal(again, matrix)
    difference = f"{relative_error(matrix, torch.cat(rows)):.0e}"
    return [
        f"{name}, {method}",
        str(runs),
        f"{together:.1f} s",
        f"{apart:.1f} s",
        difference,
        f"{1e3 * disk:.0f} ms",
    ]
