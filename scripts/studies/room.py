"""Losses of the foci if panel, table or walls around an AUTD3 are left out of the model.

Writes room.png and a block of the documentation. One drive is the best for free air; another knows the
planes. Both play in the scene with the planes. Takes about ten minutes on 2 idle cores.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from matplotlib.figure import Figure
from shared.document import Page, printed, table
from shared.scenes import weakest

import autdtorch as at

DOCUMENT = "room.md"
OPTIONS = {"--spacing": {"type": float, "default": 1.5, "help": "of the simulations [mm]"}}

ARRAY = at.TransducerArray.autd3((0, 0, 0), normal=(0, 0, 1))
FOCI = at.circle_points(center=(0, 0, 150e-3), radius=40e-3, count=4, normal=(0, 0, 1))
PLANE = at.Plane(center=(-5e-3, 0, 95e-3), normal=(0, 1, 0), size=(210e-3, 222e-3))
"""Plane of the picture, which reaches 10 mm behind panel and table."""
TABLE = at.Reflector((-106e-3, 0, 0), (1, 0, 0))
"""Table 20 mm beside the outermost transducers of the array, which stands upright and faces along z."""

ROOMS: Mapping[str, Sequence[at.Reflector]] = {
    "flush in a panel": [at.Reflector.behind(ARRAY)],
    "on a table": [TABLE],
    "between walls": [at.Reflector((-150e-3, 0, 0), (1, 0, 0)), at.Reflector((150e-3, 0, 0), (-1, 0, 0))],
}
TILTED = {"center": (0, 0, 80e-3), "rotation_degrees": (0, 20, 0), "rigid": True}
FELT = at.Box((-101e-3, 0, 100e-3), (10e-3, 200e-3, 200e-3), **at.porous(200e3))
"""Felt of 10 mm on the table, along the beam."""

BODIES: Mapping[str, Sequence[at.Obstacle]] = {
    "nothing": [],
    "plate": [at.Box(size=(40e-3, 40e-3, 3e-3), **TILTED)],
    "phone": [at.Box(size=(150e-3, 75e-3, 8e-3), **TILTED)],
}
TOO_LONG = {("phone", "between walls")}
"""Cases left out: some 200 images of a large box take more than five minutes."""
SHOWN = "plate"
"""Body of the picture."""
LOUDEST = 5e3
"""Upper end of its colours [Pa]; next to the transducers it is louder."""


class Case(NamedTuple):
    """A body in a room, and the weakest foci [Pa] there."""

    body: str
    room: str
    changed: float  # share of the transfer matrix, up to one gain
    ignorant: float  # drive for free air
    knowing: float
    bound: float


def main(page: Page, spacing: float) -> None:
    head = ["in the beam", "AUTD3", "matrix changes by [%]"]
    head += ["drive for free air", "drive that knows", "lost [%]"]
    page.write(
        table(head, printed(cells(case) for case in cases(1e-3 * spacing))),
        f"Weakest of four foci 150 mm in front of the array [Pa], cells of {spacing:g} mm; changes beyond\n"
        "a common gain. The table is 20 mm beside the transducers, the felt on it is 10 mm thick, walls are\n"
        "300 mm apart. Plate (40 x 40 x 3 mm) and phone (150 x 75 x 8 mm) are rigid, tilted and 80 mm away.",
        "![Sound pressure around a tilted plate: in free air, with a panel, with a table](room.png)",
    )
    page.save("room.png", picture(1e-3 * spacing))


def scene_of(bodies: Sequence[at.Obstacle], room: Sequence[at.Reflector]) -> at.Scene:
    """Return the array with bodies in its beam, in a room."""
    return at.Scene(ARRAY, at.Medium.air(), 40e3, FOCI, bodies, reflectors=room)


def cases(spacing: float) -> Iterator[Case]:
    for body, bodies in BODIES.items():
        free = at.make_propagator(scene_of(bodies, []), spacing=spacing).transfer_matrix()
        drive = at.holography(free, starts=8)
        for room, planes in ROOMS.items():
            if (body, room) in TOO_LONG:
                continue
            matrix = at.make_propagator(scene_of(bodies, planes), spacing=spacing).transfer_matrix()
            yield judged(body, room, free, drive, matrix)
        if not bodies:
            felt = at.make_propagator(scene_of([FELT], [TABLE]), spacing=spacing).transfer_matrix()
            yield judged(body, "on felt", free, drive, felt)


def judged(body: str, room: str, free: torch.Tensor, drive: torch.Tensor, matrix: torch.Tensor) -> Case:
    """Compare a drive (M,) for the matrix of free air (P, M) with one for the matrix of the room."""
    gain = (free.conj() * matrix).sum() / free.norm() ** 2
    changed = float((matrix - gain * free).norm() / (gain * free).norm())
    knowing = weakest(matrix, at.holography(matrix, starts=8))
    ignorant = weakest(matrix, drive)
    return Case(body, room, changed, float(ignorant), float(knowing), at.focus_bound(matrix))


def cells(case: Case) -> list[str]:
    pressures = [f"{value:.0f}" for value in (case.ignorant, case.knowing)]
    shares = [f"{abs(100 * share):.1f}" for share in (case.changed, 1 - case.ignorant / case.knowing)]
    return [case.body, case.room, shares[0], *pressures, shares[1]]


def picture(spacing: float) -> Figure:
    """Draw the fields of the drive for free air."""
    bodies = BODIES[SHOWN]
    rooms = {"free air": [], **{room: ROOMS[room] for room in ("flush in a panel", "on a table")}}
    propagators = {
        room: at.make_propagator(scene_of(bodies, planes), spacing=spacing) for room, planes in rooms.items()
    }
    drive = at.holography(propagators["free air"].transfer_matrix(), starts=8)
    points = PLANE.points(spacing=1e-3)
    maps = {room: {"drive for free air": each.field(drive, points)} for room, each in propagators.items()}
    alike = (dict.fromkeys(rooms, each) for each in (PLANE, FOCI, bodies))
    return at.plot_planes(maps, *alike, reflectors=rooms, vmax=LOUDEST)
