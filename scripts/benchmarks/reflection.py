"""A constant reflection factor against the exact field before a plane with an impedance.

A plane of impedance Z, as a ratio to air, reflects a plane wave at the angle t from its normal by
(Z cos t - 1) / (Z cos t + 1). `at.Reflector` has one factor for all angles. Writes a block of the
documentation, the rms error of a transfer matrix for the factor of the normal and for the best constant, and
prints that for the factor at the angle of each mirror image. Then times bodies in front of an array without
and with its panel.
"""

from collections.abc import Iterator

import torch
from shared.document import Page, printed, table
from shared.timing import timed

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
TILT = (0.2, 0.3, 0.1)
BODIES = {  # 80 mm in front of the array
    "plate of 40 mm": at.Box((0.0, 0.0, 80e-3), (40e-3, 40e-3, 2e-3), rigid=True, rotation=TILT),
    "plate of 80 mm": at.Box((0.0, 0.0, 80e-3), (80e-3, 80e-3, 2e-3), rigid=True, rotation=TILT),
    "phone": at.Box((0.0, 0.0, 80e-3), (150e-3, 75e-3, 8e-3), rigid=True, rotation=TILT),
}
FOCI = at.circle_points((0.0, 0.0, 0.15), 20e-3, 4, (0.0, 0.0, 1.0))


def main(page: Page) -> None:
    """Print all errors, and write the block."""
    lines = printed(rows())
    errors = {(plane, ratio): normal for plane, ratio, _, normal, *_ in lines}
    ratios = [f"{impedance:g}" for impedance in IMPEDANCES]
    page.write(
        "Error of the transfer matrix of 16 x 16 transducers [%] with the factor of the normal, by "
        "the impedance of the plane:",
        table(["plane", *ratios], ([plane, *(errors[plane, ratio] for ratio in ratios)] for plane in PLANES)),
        "Time of a transfer matrix of 4 points [s] by 16 x 16 discs without and in their panel, 1 mm:",
        table(["body 80 mm away", "without", "panel", "ratio"], printed(times())),
    )


def rows() -> Iterator[list[str]]:
    """Compare the factors for every plane and impedance."""
    array = at.TransducerArray.grid((16, 16), 10e-3, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    sources = array.positions[::5]
    points = at.Plane((0.0, 0.0, 0.15), (0.0, 1.0, 0.0), (0.08, 0.08)).points(0.02).flatten(0, 1)
    wavenumber = at.Scene(array, AIR, FREQUENCY, points).wavenumber
    direct = at.green(points, sources, wavenumber)
    for name, (origin, normal) in PLANES.items():
        where = points, sources, wavenumber, origin, normal
        image = at.analytic.rigid_plane(*where, scattered=True)
        cosine = angle_cosines(points, sources, origin, normal)
        for impedance in IMPEDANCES:
            reflected = at.analytic.impedance_plane(*where, impedance, scattered=True)
            size = (direct + reflected).norm()
            best = (image.conj() * reflected).sum() / image.norm() ** 2
            factor = (impedance - 1) / (impedance + 1)
            by_angle = (impedance * cosine - 1) / (impedance * cosine + 1)
            errors = [(each * image - reflected).norm() / size for each in (factor, best, by_angle)]
            yield [
                name,
                f"{impedance:g}",
                f"{factor:.3f}",
                *(f"{100 * float(error):.2g}" for error in errors),
            ]


def times() -> Iterator[list[str]]:
    """Time each body without and with the panel, once all is compiled."""
    array = at.TransducerArray.sonicsurface((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))

    def seconds(body: at.Box, reflectors: list[at.Reflector]) -> float:
        scene = at.Scene(array, AIR, FREQUENCY, FOCI, [body], reflectors=reflectors)
        propagator = at.make_propagator(scene, "box", 1e-3, cache=False)
        return timed(propagator.transfer_matrix)[1]

    panel = [at.Reflector.behind(array)]
    seconds(BODIES["plate of 40 mm"], panel)
    for name, body in BODIES.items():
        free, before = seconds(body, []), seconds(body, panel)
        yield [name, f"{free:.2f}", f"{before:.2f}", f"{before / free:.2f}"]


def angle_cosines(
    points: torch.Tensor,
    sources: torch.Tensor,
    origin: tuple[float, float, float],
    normal: tuple[float, float, float],
) -> torch.Tensor:
    """Return the cosines (P, M) of the angles from the normal at which rays are reflected."""
    axis = torch.nn.functional.normalize(points.new_tensor(normal), dim=0)
    heights = [(places - points.new_tensor(origin)) @ axis for places in (points, sources)]
    images = sources - 2 * heights[1][:, None] * axis
    return (heights[0][:, None] + heights[1]) / (points[:, None] - images).norm(dim=-1)
