"""A constant reflection factor against the exact field before a plane with an impedance.

A plane of impedance Z, as a ratio to air, reflects a plane wave at the angle t from its normal by
(Z cos t - 1) / (Z cos t + 1). `at.Reflector` has one factor for all angles. Writes a block of the
documentation, the rms error of a transfer matrix for the factor of the normal.
"""

from collections.abc import Iterator

from shared.document import Page, table

import autdtorch as at

DOCUMENT = "room.md"

AIR, FREQUENCY = at.Medium(1.2, 343.0), 40e3
PLANES = {  # a point and the normal of each, about an array of 160 mm in z = 0 that faces z
    "wall opposite, 300 mm away": ((0.0, 0.0, 0.3), (0.0, 0.0, -1.0)),
    "wall at 45 degrees": ((-0.2, 0.0, 0.2), (1.0, 0.0, -1.0)),
    "panel, 5 mm behind": ((0.0, 0.0, -5e-3), (0.0, 0.0, 1.0)),
    "table beside, 20 mm away": ((-0.095, 0.0, 0.0), (1.0, 0.0, 0.0)),
}
IMPEDANCES = (100.0, 20.0, 5.0, 1.5 + 1j)


def main(page: Page) -> None:
    page.write(
        "Error of the transfer matrix of 16 x 16 transducers [%] with the factor of the normal, by "
        "the impedance of the plane:",
        table(["plane", *(f"{impedance:g}" for impedance in IMPEDANCES)], rows()),
    )


def rows() -> Iterator[list[str]]:
    """Yield a plane's name and its errors by impedance."""
    array = at.TransducerArray.grid((16, 16), 10e-3, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    sources = array.positions[::5]
    points = at.Plane((0.0, 0.0, 0.15), (0.0, 1.0, 0.0), (0.08, 0.08)).points(0.02).flatten(0, 1)
    wavenumber = at.Scene(array, AIR, FREQUENCY, points).wavenumber
    direct = at.green(points, sources, wavenumber)
    for name, plane in PLANES.items():
        where = points, sources, wavenumber, *plane
        image = at.analytic.rigid_plane(*where, scattered=True)
        errors = []
        for impedance in IMPEDANCES:
            reflected = at.analytic.impedance_plane(*where, impedance, scattered=True)
            factor = (impedance - 1) / (impedance + 1)
            errors.append(float((factor * image - reflected).norm() / (direct + reflected).norm()))
        yield [name, *(f"{100 * error:.2g}" for error in errors)]
