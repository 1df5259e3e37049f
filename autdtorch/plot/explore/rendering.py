"""The picture of a situation: meshes of bodies, foci, transducers and the field, which are moved."""

from __future__ import annotations

import math
import operator
from typing import Any, NamedTuple

import numpy as np
import torch

from autdtorch.plot import colours, meshes3d, plotter3d
from autdtorch.plot.data import MM, in_decibels
from autdtorch.plot.explore.situation import Situation
from autdtorch.scene.arrays import radii_of
from autdtorch.scene.geometry import Plane, rotation_matrix
from autdtorch.scene.obstacles.moving import angles_of, circumscribed
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import Vector

DIGITS = 7
"""Decimals of lengths [m] from the page, whose steps are 0.1 mm."""

_INK = {False: ("black", "white"), True: ("#e6e6e6", "#14171c")}  # lines and background, by dark
_SAMPLES = 600  # along a ray through the scene, to find the body under the mouse
_AROUND = 1.05  # height of the window, relative to the domain's sphere; leaves room for letters
_LETTERS = 9.0  # size of tick labels and titles
_SAMPLES_A_PIXEL = 4
_MARK, _WIRE = 0.33, 0.04  # wavelengths: radii of the ring around a focus, so that it is seen, and its wire
_CHOSEN = 1.6  # size of the ring around the chosen focus
_SLANTING = 0.2  # sine of the least angle of a line of sight to a plane in which something is dragged
_RING = 1.1, 1.4  # radii of the ring around the chosen transducer, relative to its disc
_SURFACE_NAME, _FORCE_NAME = "isosurface", "force"
_ARROW = 2.5  # wavelengths: length of the arrow of the force
_FORCE_COLOUR = "#D81B60"  # not in the colour map of the pressure, on light and dark


class Scale(NamedTuple):
    """The colours of pressures: from 0 to `reference` [Pa], or from -30 dB to 0 dB, which is `reference`."""

    reference: float
    decibels: bool

    def values(self, magnitude: Array) -> Array:
        """Return the values that colour |p| (Nu, Nv) [Pa], at least the lower limit; NaN stays."""
        if self.decibels:
            return np.maximum(in_decibels(magnitude, self.reference), colours.FLOOR)
        return magnitude

    @property
    def limits(self) -> tuple[float, float]:
        """Ends of the colour scale."""
        return (colours.FLOOR, 0.0) if self.decibels else (0.0, self.reference)


class Grip(NamedTuple):
    """A hold of the mouse on an object in the picture.

    Attributes:
        kind: "body", "focus" or "transducer".
        number: index of the object.
        place: the point of the object under the mouse (3,) [m].
        origin: centre of the object when it was gripped (3,) [m].
        angles: angles of a body when it was gripped (3,) [rad].
    """

    kind: str
    number: int
    place: Array
    origin: Array
    angles: Vector = (0.0, 0.0, 0.0)

    def dragged(self, situation: Situation, place: Array) -> Situation:
        """Return a situation with the body or focus moved so that its grip is at a place (3,) [m]."""
        offset = np.round(MM * (place - self.place), 1) / MM
        center = (self.origin + offset).round(DIGITS)
        if self.kind == "body":
            x, y, z = center.tolist()
            return situation.with_body(self.number, (x, y, z), situation.bodies[self.number].angles)
        points = situation.scene.control_points.clone()
        points[self.number] = points.new_tensor(center)
        return situation.with_points(points)

    def turned(self, situation: Situation, angle: float) -> Situation:
        """Return a situation with the body turned about the vertical by an angle [rad] from its grip."""
        turn = rotation_matrix((0.0, 0.0, angle)) @ rotation_matrix(self.angles)
        a, b, c = angles_of(turn).tolist()
        return situation.with_body(self.number, situation.bodies[self.number].center, (a, b, c))


class Rendering:
    """The picture. All its methods are called in one thread, as OpenGL requires."""

    def __init__(self, situation: Situation) -> None:
        """Draw a situation, as yet without a field."""
        self.plotter = plotter3d.empty_plotter(situation.scene.domain, off_screen=True)
        self._dark = False
        self._domain: Any = None  # that the camera looks at
        self.draw(situation)
        self.plotter.render_window.AddObserver("WindowResizeEvent", lambda *_: self._fit())

    def shows(self, situation: Situation) -> bool:
        """Return whether bodies, array, domain and reflectors of a situation are those of the picture."""
        scene, drawn = situation.scene, self._situation
        bodies, others = ([body.original for body in each.bodies] for each in (situation, drawn))
        same_bodies = len(bodies) == len(others) and all(map(operator.is_, bodies, others))
        same_room = scene.domain == drawn.scene.domain and scene.reflectors == drawn.scene.reflectors
        return same_bodies and same_room and scene.array is drawn.scene.array

    def draw(self, situation: Situation) -> None:
        """Draw another situation, as yet without a field. The camera stays if the domain is equal."""
        scene, self._situation = situation.scene, situation
        self.plotter.clear_actors()
        self._bodies = [meshes3d.add_obstacle(self.plotter, body.original) for body in situation.bodies]
        meshes3d.cut_at_reflectors([actor for actors in self._bodies for actor in actors], scene.reflectors)
        meshes3d.add_reflectors(self.plotter, scene)
        self._foci: list[Any] = []
        self._faces = meshes3d.add_transducers(
            self.plotter, scene, meshes3d.emitted_phases(situation.drive, len(scene.array)), bar=False
        )
        self._ringed, self._ring = 0, self._around(0)
        self.plotter.add_mesh(self._ring, color=colours.FOCUS_COLOUR, lighting=False, reset_camera=False)
        self._sheet = meshes3d.plane_mesh(situation.sheet, np.full((1, 1), math.nan))
        self._actor = meshes3d.add_sheet(self.plotter, self._sheet, colours.PRESSURE_MAP, (0.0, 1.0))
        self.set_dark(self._dark)
        self.place(situation, 0, 0)
        if scene.domain != self._domain:
            self._domain = scene.domain
            plotter3d.look_at(self.plotter, scene.domain)
            self._fitted = self.plotter.camera.parallel_scale
            self._first = self.plotter.camera_position
            self._fit()

    def _fit(self) -> None:
        """Show the whole domain in a window of another size, unless the user has zoomed."""
        camera = self.plotter.camera
        if camera.parallel_scale == self._fitted:
            width, height = self.plotter.render_window.GetSize()
            lower, upper = map(np.array, self._situation.scene.domain)
            radius = MM * float(np.linalg.norm(upper - lower)) / 2
            camera.parallel_scale = self._fitted = _AROUND * radius * max(1.0, height / width)

    def move_camera(self, azimuth: float, elevation: float, zoom: float) -> None:
        """Turn the camera [degrees] around the domain, and zoom by a factor; a factor of 0 sets both back."""
        camera = self.plotter.camera
        if zoom:
            camera.Azimuth(azimuth)
            camera.Elevation(elevation)
            camera.OrthogonalizeViewUp()
            camera.Zoom(zoom)
        else:
            self.plotter.camera_position = self._first
            camera.parallel_scale = self._fitted
        self.plotter.renderer.ResetCameraClippingRange()

    def set_dark(self, dark: bool) -> None:
        """Choose light lines on a dark background, or dark on light."""
        self._dark = dark
        ink, paper = _INK[dark]
        self.plotter.set_background(paper)
        plotter3d.add_axes(self.plotter, self._situation.scene.domain, ink, _LETTERS)
        self.plotter.actors[meshes3d.ARROWS].prop.color = ink

    def place(self, situation: Situation, focus: int, transducer: int) -> None:
        """Move bodies and foci; mark the chosen focus and transducer by their indices."""
        self._situation = situation
        for actors, body in zip(self._bodies, situation.bodies, strict=True):
            for actor in actors:
                actor.user_matrix = _matrix(*body.pose)
        points = MM * situation.scene.control_points.numpy()
        while len(self._foci) > len(points):
            self.plotter.remove_actor(self._foci.pop(), reset_camera=False, render=False)
        while len(self._foci) < len(points):
            radius, wire = (MM * share * situation.scene.wavelength for share in (_MARK, _WIRE))
            look = {"color": colours.FOCUS_COLOUR, "ambient": 0.5, "reset_camera": False}
            self._foci.append(self.plotter.add_mesh(meshes3d.torus_mesh(radius, wire), **look))
        across = np.stack([axis.numpy() for axis in situation.sheet.basis])
        axes = np.vstack([across, np.cross(*across)]).T  # rings lie in the plane of the field
        for index, (point, ring) in enumerate(zip(points, self._foci, strict=True)):
            matrix = np.eye(4)
            matrix[:3, :3] = (_CHOSEN if index == focus else 1.0) * axes
            matrix[:3, 3] = point
            ring.user_matrix = matrix
        if transducer != self._ringed:
            self._ringed = transducer
            self._ring.copy_from(self._around(transducer))
        self.show_drive(situation.drive)

    def _around(self, transducer: int) -> Any:
        """Return a ring around the disc of a transducer."""
        array = self._situation.scene.array
        center, normal = MM * array.positions[transducer].numpy(), array.normals[transducer].tolist()
        disc = self._faces.points.reshape(len(array), -1, 3)[transducer]
        inner, outer = (share * float(np.linalg.norm(disc - center, axis=1).max()) for share in _RING)
        return meshes3d.ring_mesh(center, normal, inner, outer)

    def smooth(self, fine: bool) -> None:
        """Render with smooth edges, which takes four times as long, or without while something is dragged."""
        self.plotter.render_window.SetMultiSamples(_SAMPLES_A_PIXEL if fine else 0)

    def show_drive(self, drive: torch.Tensor) -> None:
        """Colour the transducers by the phases of a drive (M,)."""
        phases = meshes3d.emitted_phases(drive, len(drive))
        self._faces["phase"] = np.repeat(phases / math.pi, self._faces.n_points // len(drive))

    def show_field(self, plane: Plane, magnitude: Array, scale: Scale) -> None:
        """Colour a plane by |p| (Nu, Nv) [Pa]; grey where it is NaN."""
        self._sheet.copy_from(meshes3d.plane_mesh(plane, scale.values(magnitude)))
        self._actor.mapper.scalar_range = scale.limits

    def show_force(self, body: int, force: Array | None) -> None:
        """Draw the direction of the force (3,) on a body as an arrow away from it, or nothing."""
        self.plotter.remove_actor(_FORCE_NAME, reset_camera=False, render=False)
        if force is None:
            return
        center, radius = circumscribed([self._situation.bodies[body].obstacle])
        along, length = force / np.linalg.norm(force), _ARROW * self._situation.scene.wavelength
        arrow = meshes3d.arrow_mesh(MM * (center.numpy() + radius * along), along, MM * length)
        look = {"color": _FORCE_COLOUR, "name": _FORCE_NAME, "lighting": False, "reset_camera": False}
        self.plotter.add_mesh(arrow, **look)

    def show_volume(self, volume: torch.Tensor | None, scale: Scale, height: float) -> bool:
        """Draw the surface where the level of a volume (Nx, Ny, Nz) [Pa] is `height` [dB], or nothing.

        Return False where a volume has no such surface.
        """
        self.plotter.remove_actor(_SURFACE_NAME, reset_camera=False, render=False)
        if volume is None:
            return True
        level = in_decibels(volume.abs().numpy(), scale.reference)
        return meshes3d.add_isosurface(self.plotter, self._situation.scene, level, height, name=_SURFACE_NAME)

    def grip(self, x: float, y: float) -> Grip | None:
        """Return a hold on the object at a point of the window [pixels from its lower left corner]."""
        near, far = (self.at(x, y, depth) for depth in (0.0, 1.0))
        scene = self._situation.scene
        ray = torch.from_numpy(near + np.linspace(0, 1, _SAMPLES)[:, None] * (far - near))
        hits: list[tuple[int, Grip]] = []
        radii = radii_of(scene.array)
        for kind, places, radius in (
            ("focus", scene.control_points, scene.wavelength / 4),
            ("transducer", scene.array.positions, torch.where(radii > 0, radii, scene.wavelength / 3)),
        ):
            gaps = torch.cdist(ray, places) - radius
            if gaps.min() < 0:
                index = int(gaps.min(dim=0).values.argmin())
                place = places[index].numpy()
                hits.append((int(gaps[:, index].argmin()), Grip(kind, index, place, place)))
        for index, body in enumerate(self._situation.bodies):
            inside = body.obstacle.contains(ray)
            if inside.any():
                first = int(inside.int().argmax())
                grip = Grip("body", index, ray[first].numpy(), np.array(body.center), body.angles)
                hits.append((first, grip))
        return min(hits, key=lambda hit: hit[0])[1] if hits else None

    def at(self, x: float, y: float, depth: float) -> Array:
        """Return the place (3,) [m] of a point of the window at a depth, 0 near to 1 far."""
        renderer = self.plotter.renderer
        renderer.SetDisplayPoint(x, y, depth)
        renderer.DisplayToWorld()
        *point, weight = renderer.GetWorldPoint()
        place: Array = np.array(point) / weight / MM
        return place

    def moved(self, grip: Grip, x: float, y: float, upright: bool) -> Array:
        """Return the place (3,) [m] of a grip that follows the mouse, horizontally or `upright`."""
        near, far = (self.at(x, y, depth) for depth in (0.0, 1.0))
        return followed(grip.place, near, far - near, upright)

    def close(self) -> None:
        """Free the window."""
        self.plotter.close()


def followed(place: Array, near: Array, sight: Array, upright: bool) -> Array:
    """Return the point (3,) [m] under the mouse to which an object is dragged from a place (3,) [m].

    The point is in the horizontal plane of the place or, `upright`, on its vertical. If the line of sight is
    nearly parallel to these, the step is limited.

    Args:
        place: the place before.
        near: a point on the line of sight.
        sight: the direction of this line.
        upright: True to change the height.
    """
    sight = sight / np.linalg.norm(sight)
    offset = near - place
    offset = offset - (offset @ sight) * sight  # to the point of the line of sight that is nearest
    vertical = np.array([0.0, 0.0, 1.0])
    if upright:
        seen = vertical - sight[2] * sight
        step = (offset @ seen) / max(seen @ seen, _SLANTING**2) * vertical
    else:
        slope = math.copysign(max(abs(sight[2]), _SLANTING), sight[2])
        step = offset - offset[2] / slope * sight
        step[2] = 0.0
    point: Array = place + step
    return point


def _matrix(turn: torch.Tensor, pivot: torch.Tensor, offset: torch.Tensor) -> Array:
    """Return the matrix (4, 4), in mm, of a turn (3, 3) about a pivot (3,) [m] and an offset (3,) [m]."""
    matrix = np.eye(4)
    matrix[:3, :3] = turn.numpy()
    matrix[:3, 3] = MM * (pivot + offset - turn @ pivot).numpy()
    return matrix
