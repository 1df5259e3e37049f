"""The situation that a live view shows (bodies, foci, drive, plane of the field), its history and files."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from autdtorch.hardware.devices import DEVICES
from autdtorch.io.drive_file import save_drive
from autdtorch.io.scene_file import save_scene, scene_lines
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.drive import drive_from_phases, validate_single_drive
from autdtorch.scene.geometry import Plane, rotation_matrix
from autdtorch.scene.obstacles import Mesh, Obstacle, Sphere
from autdtorch.scene.obstacles.moving import is_movable, is_turnable, shifted, turned
from autdtorch.scene.particle import GRAVITY
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.files import replace_file
from autdtorch.utils.process import cached_property
from autdtorch.utils.spatial import volume_and_area
from autdtorch.utils.validation import ArrayLike, Vector, finite_vector, require_one_of

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
SCENE_PLANE = "scene"
"""Name of the plane that is parallel to the scene's observation plane."""

_MOST_STEPS = 200  # in the history
_MOST_BYTES = 100_000_000  # of the vertices of meshes in the history; all else is small, or shared


@dataclass(frozen=True)
class MovedObstacle:
    """An obstacle that is moved and turned about its centre.

    Attributes:
        original: the obstacle in its original pose.
        center: centre of its bounding box before turning (3,) [m].
        angles: about the axes x, y, z (3,) [rad], as of `rotation_matrix`. For boxes and meshes they are the
            obstacle's `rotation`; for cylinders they begin at 0.
    """

    original: Obstacle
    center: Vector
    angles: Vector

    @classmethod
    def of(cls, obstacle: Obstacle) -> MovedObstacle:
        """Return the body of an obstacle in its original pose."""
        return cls(obstacle, _middle(obstacle), getattr(obstacle, "rotation", (0.0, 0.0, 0.0)))

    @property
    def name(self) -> str:
        """The kind of the obstacle, in lower case."""
        return type(self.original).__name__.lower()

    @property
    def moves(self) -> bool:
        """True for an obstacle that can be moved."""
        return is_movable(self.original)

    @property
    def turns(self) -> bool:
        """True for an obstacle that can be turned."""
        return is_turnable(self.original)

    @cached_property
    def weight(self) -> float | None:
        """The weight [N] of a body of known density, by its surface."""
        density = self.original.density
        if density is None or (isinstance(density, complex) and density.imag):
            return None
        if isinstance(self.original, Sphere):
            return 4 / 3 * math.pi * self.original.radius**3 * density.real * GRAVITY
        volume, _ = volume_and_area(*(part.numpy() for part in self.original.surface()))
        return volume * density.real * GRAVITY

    @cached_property
    def pose(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Rotation (3, 3) about a pivot (3,) [m], then offset (3,) [m], from the original pose."""
        pivot = torch.tensor(_middle(self.original), **REAL)
        turn = rotation_matrix(self.angles) @ rotation_matrix(MovedObstacle.of(self.original).angles).mT
        return turn, pivot, pivot.new_tensor(self.center) - pivot

    @cached_property
    def obstacle(self) -> Obstacle:
        """The obstacle in its present pose."""
        if self == MovedObstacle.of(self.original):
            return self.original
        turn, pivot, offset = self.pose
        return shifted(turned(self.original, turn, pivot) if self.turns else self.original, offset)


@dataclass(frozen=True, eq=False)
class Situation:
    """All that a live view shows and that is undone step by step.

    Attributes:
        bodies: the obstacles of the scene.
        scene: the scene, with the obstacles of the bodies.
        drive: complex (M,).
        plane: name of the plane of the field: "x", "y" or "z" for a section of the domain across this axis,
            "scene" for the scene's observation plane.
        height: place of the plane along its normal [m]; shift of the scene's observation plane.
        reference: pressure of the brightest colour [Pa]; None to fit it to the next field.
    """

    bodies: tuple[MovedObstacle, ...]
    scene: Scene
    drive: torch.Tensor
    plane: str
    height: float
    _scene_plane: Plane | None = field(repr=False)
    reference: float | None = None

    @classmethod
    def of(cls, scene: Scene, drive: torch.Tensor) -> Situation:
        """Return the first situation of a scene."""
        bodies = tuple(map(MovedObstacle.of, scene.obstacles))
        if (plane := scene.observation_plane) is not None:
            return cls(bodies, scene, drive, SCENE_PLANE, 0.0, plane)
        middle = scene.control_points.mean(dim=0)
        axis = int((middle - scene.array.positions.mean(dim=0)).abs().argmax())
        return cls(bodies, scene, drive, "xyz"[axis], float(middle[axis]), None)

    @property
    def planes(self) -> tuple[str, ...]:
        """Names that `plane` can have."""
        return (*_AXES, SCENE_PLANE) if self._scene_plane is not None else tuple(_AXES)

    @property
    def heights(self) -> tuple[float, float]:
        """Range of `height` within the domain [m]."""
        lower, upper = self.scene.domain
        if self.plane in _AXES:
            axis = "xyz".index(self.plane)
            return lower[axis], upper[axis]
        assert self._scene_plane is not None
        normal, middle = self._scene_plane.normal, self._scene_plane.center
        steps = [
            sorted(((low - at) / along, (high - at) / along))
            for along, at, low, high in zip(normal, middle, lower, upper, strict=True)
            if abs(along) > 1e-9
        ]
        return max(low for low, _ in steps), min(high for _, high in steps)

    @cached_property
    def sheet(self) -> Plane:
        """The plane of the field."""
        if self.plane == SCENE_PLANE:
            assert self._scene_plane is not None
            along = zip(self._scene_plane.center, self._scene_plane.normal, strict=True)
            x, y, z = (at + self.height * step for at, step in along)
            return replace(self._scene_plane, center=(x, y, z))
        axis = "xyz".index(self.plane)
        lower, upper = self.scene.domain
        center = [(low + high) / 2 for low, high in zip(lower, upper, strict=True)]
        center[axis] = self.height
        size = [high - low for low, high in zip(lower, upper, strict=True)]
        return Plane(
            (center[0], center[1], center[2]), _AXES[self.plane], (size[(axis + 1) % 3], size[(axis + 2) % 3])
        )

    def with_body(self, index: int, center: Vector, angles: Vector) -> Situation:
        """Return the situation with a body elsewhere: centre (3,) [m] and angles (3,) [rad].

        Raises:
            ValueError: the body cannot be there, such as on a control point.
        """
        body = self.bodies[index]
        moved = replace(
            body,
            center=finite_vector("center", center) if body.moves else body.center,
            angles=finite_vector("angles", angles, "rad") if body.turns else body.angles,
        )
        if moved == body:
            return self
        bodies = (*self.bodies[:index], moved, *self.bodies[index + 1 :])
        obstacles = tuple(body.obstacle for body in bodies)
        return replace(self, bodies=bodies, scene=replace(self.scene, obstacles=obstacles))

    def with_scene(self, scene: Scene) -> Situation:
        """Return the situation of another scene, with this drive for an equal array, else all in phase."""
        stays = same_array(scene.array, self.scene.array)
        drive = self.drive if stays else in_phase(scene)
        changed = replace(Situation.of(scene, drive), reference=self.reference if stays else None)
        return changed.with_plane(self.plane, self.height) if self.plane in _AXES else changed

    def with_points(self, points: torch.Tensor) -> Situation:
        """Return the situation with other control points (P, 3) [m].

        Raises:
            ValueError: a point cannot be there.
        """
        if torch.equal(points, self.scene.control_points):
            return self
        return replace(self, scene=replace(self.scene, control_points=points))

    def with_drive(self, drive: torch.Tensor) -> Situation:
        """Return the situation with another drive (M,)."""
        if torch.equal(drive, self.drive):
            return self
        return replace(self, drive=validate_single_drive(drive, len(self.scene.array)))

    def with_transducer(self, index: int, phase: float, amplitude: float) -> Situation:
        """Return the situation with another phase [rad] and amplitude of a transducer.

        Raises:
            ValueError: the amplitude is not in [0, 1].
        """
        drive = self.drive.clone()
        drive[index] = drive_from_phases([phase], [amplitude])[0]
        return self.with_drive(drive)

    def with_reference(self, reference: float | None) -> Situation:
        """Return the situation with another pressure of the brightest colour [Pa]; None to fit it."""
        return self if reference == self.reference else replace(self, reference=reference)

    def with_plane(self, plane: str, height: float | None = None) -> Situation:
        """Return the situation with another plane; without a height it passes through the foci."""
        require_one_of("plane", plane, self.planes)
        changed = replace(self, plane=plane, height=0.0)
        if height is None and plane in _AXES:
            height = float(self.scene.control_points.mean(dim=0)["xyz".index(plane)])
        low, high = changed.heights
        height = min(max(height or 0.0, low), high)
        return self if (plane, height) == (self.plane, self.height) else replace(changed, height=height)


class History:
    """The present situation, and those before and after it; a drag is one step of many situations.

    Attributes:
        now: the situation that is shown.
    """

    def __init__(self, situation: Situation) -> None:
        """Begin at a situation."""
        self.now = situation
        self._done: list[Situation] = []
        self._undone: list[Situation] = []
        self._before: Situation | None = None

    @property
    def can_undo(self) -> bool:
        """True if there is a step to undo."""
        return bool(self._done) or self._before is not None

    @property
    def can_redo(self) -> bool:
        """True if there is a step to repeat."""
        return bool(self._undone)

    def change(self, situation: Situation) -> None:
        """Show another situation; the step ends with `settle`."""
        if situation is self.now:
            return
        if self._before is None:
            self._before = self.now
        self.now = situation

    def amend(self, situation: Situation) -> None:
        """Replace the present situation without a step."""
        self.now = situation

    def step(self, situation: Situation) -> None:
        """Show another situation, as a complete step."""
        self.settle()
        self.change(situation)
        self.settle()

    def settle(self) -> bool:
        """End a step; return False if none has begun."""
        if self._before is None:
            return False
        self._done = [*self._done, self._before][-_most_steps(self.now) :]
        self._undone, self._before = [], None
        return True

    def undo(self) -> None:
        """Go back to the situation before the last step."""
        self.settle()
        if self._done:
            self._undone.append(self.now)
            self.now = self._done.pop()

    def redo(self) -> None:
        """Repeat a step that was undone."""
        if self._undone:
            self._done.append(self.now)
            self.now = self._undone.pop()


def in_phase(scene: Scene) -> torch.Tensor:
    """Return the drive (M,) with phase 0 and amplitude 1."""
    return torch.ones(len(scene.array), **COMPLEX)


def checked_drive(drive: ArrayLike, scene: Scene) -> torch.Tensor:
    """Return a drive (M,) of a scene, complex128 on the CPU, after checking it."""
    return validate_single_drive(drive, len(scene.array)).detach().to("cpu", torch.complex128)


def same_array(one: TransducerArray, other: TransducerArray) -> bool:
    """Return whether two arrays have equal positions and normals."""
    return torch.equal(one.positions, other.positions) and torch.equal(one.normals, other.normals)


def _middle(obstacle: Obstacle) -> Vector:
    x, y, z = ((low + high) / 2 for low, high in zip(obstacle.lower, obstacle.upper, strict=True))
    return getattr(obstacle, "center", (x, y, z))


def _most_steps(situation: Situation) -> int:
    size = sum(
        obstacle.vertices.nbytes for obstacle in situation.scene.obstacles if isinstance(obstacle, Mesh)
    )
    return max(1, min(_MOST_STEPS, _MOST_BYTES // max(size, 1)))


SCENE = "scene"
"""Name of the scene file and, with a number, of meshes beside it."""

_FOLDER = Path("outputs/explore")


def free_folder() -> str:
    """Return the name of a folder that does not exist yet."""
    names = (f"{_FOLDER}_{number}" if number > 1 else str(_FOLDER) for number in itertools.count(1))
    return next(name for name in names if not Path(name).exists())


def python_of(situation: Situation, folder: str) -> str:
    """Return the lines of Python that make scene and drive; meshes are read from files saved in a folder.

    Raises:
        ValueError: an obstacle of a user's class.
    """
    return scene_lines(situation.scene, situation.drive, str(Path(folder) / SCENE))


def devices_of(situation: Situation) -> list[str]:
    """Return the names of the devices whose boards have the number of transducers."""
    count = len(situation.drive)
    return [name for name, device in DEVICES.items() if count % device.board == 0]


def save_situation(situation: Situation, folder: str, device: str, replaces: bool) -> Path:
    """Write scene.yaml, drive.npz, scene.py and, for a device, its levels; return the folder.

    Args:
        situation: scene and drive.
        folder: to write into, below the working directory; it is made.
        device: a name in `devices_of`, or "".
        replaces: whether files in the folder are replaced.

    Raises:
        ValueError: a folder elsewhere, one that is not empty and not to be replaced, or another device.
        OSError: the files cannot be written.
    """
    path, here = Path(folder), Path.cwd().resolve()
    if not folder.strip() or path.is_absolute() or not (here / path).resolve().is_relative_to(here):
        raise ValueError(f"folder: {folder!r}; must be below the working directory")
    if device and device not in devices_of(situation):
        raise ValueError(f"device: {device!r}; must be one of {devices_of(situation)}")
    if not replaces and path.exists() and any(path.iterdir()):
        raise ValueError(f"folder: {folder!r} has other files; must be new or empty")
    path.mkdir(parents=True, exist_ok=True)
    save_scene(path / f"{SCENE}.yaml", situation.scene)
    save_drive(path / "drive.npz", situation.drive, situation.scene.array)
    if device:
        save_drive(path / f"drive_{device}.csv", situation.drive, situation.scene.array, device)
    lines = scene_lines(situation.scene, situation.drive, SCENE, beside=True)
    replace_file(path / f"{SCENE}.py", lines.encode())
    return path
