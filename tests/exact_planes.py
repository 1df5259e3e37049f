"""Exact fields in front of reflecting planes: spheres, corners, waveguides and panels.

Fields are those of point sources in units of `analytic.green`, e^{ikr} / (4 pi r), complex128 (P, M), with
e^{-i w t}. A plane with a reflection factor R multiplies every wave by R when it reflects it: the field is
u(x) + R u(mirrored x), u the sum of what sources and bodies radiate.
"""

import math
from dataclasses import dataclass, field
from itertools import product

import numpy as np
import torch
from scipy.special import hankel1

from autdtorch.analytic.green import piston_field
from autdtorch.scene.arrays import strengths_of
from autdtorch.utils.process import one_library_thread

_DEGREE = 50  # of spherical waves: for 1e-10 at a gap of a sixteenth of the radius
_AROUND = 96  # samples along a parallel of the sphere
_RESOLVED = 1e-11  # of the largest Fourier coefficient along a parallel; orders below are left out
_FLIP = np.array([1.0, 1.0, -1.0])


@dataclass
class Plane:
    """The plane through a point (3,) [m] with a normal (3,) towards the sound, and its reflection factor."""

    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    reflection: complex = 1.0
    axes: np.ndarray = field(init=False)  # rows: two directions in the plane, and the normal

    def __post_init__(self):
        """Find two directions in the plane."""
        normal = np.array(self.normal, float) / np.linalg.norm(self.normal)
        across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        across /= np.linalg.norm(across)
        self.axes = np.stack([across, np.cross(normal, across), normal])

    def heights(self, points):
        """Distances (P,) [m] of points (P, 3) from the plane, positive in front."""
        return (points - np.array(self.point)) @ self.axes[2]

    def mirrored(self, points):
        """Mirror images of points (P, 3) [m]."""
        return points - 2 * self.heights(points)[:, None] * self.axes[2]


@dataclass
class Ball:
    """A sphere: rigid, of a fluid with ratios to the medium, or with a specific impedance over rho c."""

    center: tuple[float, float, float]
    radius: float
    density_ratio: complex = math.inf
    speed_ratio: complex = 1.0
    impedance: complex = math.inf

    def condition(self, degrees, wavenumber):
        """Return dp/d(kr) over p at the surface (L + 1,) that the body imposes on waves of each degree."""
        if math.isfinite(abs(self.impedance)):
            return np.full(len(degrees), -1j / self.impedance)
        if math.isinf(abs(self.density_ratio)):
            return np.zeros(len(degrees), complex)
        return _inner_slopes(degrees, wavenumber * self.radius / self.speed_ratio) / (
            self.density_ratio * self.speed_ratio
        )


def _inner_slopes(degrees, x):
    """j_l'(x) / j_l(x), by the downward recurrence of j_(l-1) / j_l."""
    ratio, slopes = (2 * len(degrees) + 161) / x, np.empty(len(degrees), complex)
    for degree in range(len(degrees) + 79, -1, -1):
        ratio = (2 * degree + 1) / x - 1 / ratio
        if degree < len(degrees):
            slopes[degree] = ratio - (degree + 1) / x
    return slopes


def monopoles(points, sources, wavenumber):
    """Waves e^{ikr} / (4 pi r) of sources (M, 3) at points (P, 3), NumPy (P, M)."""
    distance = np.linalg.norm(points[:, None] - sources, axis=-1)
    return np.exp(1j * wavenumber * distance) / (4 * math.pi * distance)


@one_library_thread()
def sphere_before_plane(points, sources, wavenumber, ball, plane, degree=_DEGREE, scattered=False):
    """Return the field outside a sphere in front of a plane, by collocation of spherical waves.

    The scattered waves of the sphere and their mirror images meet the condition at its surface, degree by
    degree of the surface's harmonics; orders around the normal of the plane are independent. With R = 1 or
    -1 it is the field of two equal spheres. The error falls like e^(-2 degree xi), cosh xi = 1 + gap / a.

    Args:
        points: (P, 3) [m], outside the sphere, in front of the plane or on it.
        sources: (M, 3) [m], likewise, at least half a radius from the surface of the sphere.
        wavenumber: k [rad/m], complex if the medium absorbs.
        ball: the sphere, in front of the plane.
        plane: the plane.
        degree: largest degree of the waves.
        scattered: leave out the waves of the sources and of their images in the plane.
    """
    points, sources = np.asarray(points, float), np.asarray(sources, float)
    places = (points - ball.center) @ plane.axes.T
    origins = (sources - ball.center) @ plane.axes.T
    shift = np.array([0.0, 0.0, 2 * float(plane.heights(np.array([ball.center]))[0])])
    total = np.zeros((len(points), len(sources)), complex)
    for order, waves in _scattered(origins, wavenumber, ball, plane.reflection, shift, degree).items():
        outgoing, _ = _outgoing(places, order, degree, wavenumber, ball.radius)
        images, _ = _outgoing((places + shift) * _FLIP, order, degree, wavenumber, ball.radius)
        total += (outgoing + plane.reflection * images) @ waves
    if not scattered:
        total += monopoles(points, sources, wavenumber)
        total += plane.reflection * monopoles(points, plane.mirrored(sources), wavenumber)
    return torch.from_numpy(total)


def _scattered(sources, wavenumber, ball, reflection, shift, degree):
    """Return coefficients (L + 1 - |m|, M) of scattered waves by order m; places are relative to the centre.

    A place p is at flip (p + shift) from the centre of the image, in axes that are mirrored too.
    """
    nodes, weights = np.polynomial.legendre.leggauss(degree + 60)
    across = np.sqrt(1 - nodes**2)
    pressure, slope = _incident(nodes, across, sources, wavenumber, ball.radius)
    image_pressure, image_slope = _incident(nodes, across, sources * _FLIP - shift, wavenumber, ball.radius)
    pressure, slope = pressure + reflection * image_pressure, slope + reflection * image_slope
    normals = np.stack([across, 0 * nodes, nodes], axis=1)
    mirrored = (ball.radius * normals + shift) * _FLIP
    conditions = ball.condition(np.arange(degree + 1), wavenumber)
    coefficients = {}
    for order in range(_AROUND // 2):
        both = [order, -order]  # their waves differ by the sense of rotation alone
        if np.abs(pressure[:, both]).max() < _RESOLVED * np.abs(pressure).max():
            continue
        project = (_legendre(nodes, order, degree)[0] * weights[:, None]).T
        waves, gradient = _outgoing(ball.radius * normals, order, degree, wavenumber, ball.radius)
        images, image_gradient = _outgoing(mirrored, order, degree, wavenumber, ball.radius)
        slopes = np.einsum("pli,pi->pl", gradient, normals)
        slopes = slopes + reflection * np.einsum("pli,pi->pl", image_gradient, normals * _FLIP)
        condition = conditions[order:, None]
        system = project @ slopes - condition * (project @ (waves + reflection * images))
        scale = np.abs(system).max(axis=1, keepdims=True)
        for each in both:
            incident = project @ slope[:, each] - condition * (project @ pressure[:, each])
            coefficients[each] = np.linalg.solve(system / scale, -incident / scale)
    return coefficients


def _incident(nodes, across, sources, wavenumber, radius):
    """Return Fourier coefficients (N, m, M) by azimuth of waves on a sphere's parallels, and their slopes."""
    turns = 2 * math.pi * np.arange(_AROUND) / _AROUND
    x, y, z = across[:, None] * np.cos(turns), across[:, None] * np.sin(turns), nodes[:, None]
    normals = np.stack(np.broadcast_arrays(x, y, z), axis=-1)[:, :, None]
    away = radius * normals - sources
    distance = np.linalg.norm(away, axis=-1)
    wave = np.exp(1j * wavenumber * distance) / (4 * math.pi * distance)
    along = (away * normals).sum(axis=-1) / distance
    slope = wave * (1j - 1 / (wavenumber * distance)) * along
    return np.fft.fft(wave, axis=1) / _AROUND, np.fft.fft(slope, axis=1) / _AROUND


def _outgoing(places, order, degree, wavenumber, radius):
    """Return h_l(kr) / h_l(ka) Y_lm (P, L + 1 - |m|), and its gradient by k x, y, z where y = 0 <= x."""
    distance = np.linalg.norm(places, axis=1)
    outward, downward = places / distance[:, None], places[:, [2, 1, 0]] / distance[:, None] * [1, 1, -1]
    turn = np.exp(1j * order * np.arctan2(places[:, 1], places[:, 0]))[:, None]
    harmonic, turned = (turn * part for part in _legendre(outward[:, 2], abs(order), degree))
    degrees = np.arange(abs(order), degree + 1)
    x = wavenumber * distance[:, None]
    scale = 1 / _hankel(degree, np.array([[wavenumber * radius]]))[:, degrees + 1]
    at_places = _hankel(degree, x)
    before, here = at_places[:, degrees], at_places[:, degrees + 1]  # of the degrees l - 1 and l
    radial, radial_slope = scale * here, scale * (before - (degrees + 1) / x * here)
    gradient = (radial_slope * harmonic)[..., None] * outward[:, None]
    gradient = gradient + (radial / x * turned)[..., None] * downward[:, None]
    return radial * harmonic, gradient


def _legendre(cosine, order, degree):
    """Legendre functions P_lm, of norm 1, (P, L + 1 - m) at cosines (P,), and their slopes by the angle."""
    sine = np.sqrt(1 - cosine**2)
    tops = np.arange(1.0, order + 1)
    rows = [np.sqrt(0.5 * np.prod(1 + 0.5 / tops)) * sine**order]
    slopes = [order * cosine * rows[0]]
    back = 0.0
    for n in range(order + 1, degree + 1):
        factor = math.sqrt((4 * n**2 - 1) / (n**2 - order**2))
        rows.append(factor * cosine * rows[-1] - (factor / back * rows[-2] if back else 0))
        slopes.append(n * cosine * rows[-1] - (2 * n + 1) / factor * rows[-2])
        back = factor
    return np.stack(rows, axis=1), np.stack(slopes, axis=1) / np.maximum(sine, 1e-300)[:, None]


def _hankel(degree, x):
    """Spherical Hankel functions h_l(x) (P, L + 2) of x (P, 1), from l = -1 on."""
    rows = [np.exp(1j * x) / x, np.exp(1j * x) / (1j * x)]
    for n in range(degree):
        rows.append((2 * n + 1) / x * rows[-1] - rows[-2])
    return np.concatenate(rows, axis=1)


def corner(points, sources, wavenumber, planes):
    """Return the field of monopoles between planes at right angles: a sum of images in all of them."""
    points, sources = np.asarray(points, float), np.asarray(sources, float)
    total = np.zeros((len(points), len(sources)), complex)
    for chosen in product((False, True), repeat=len(planes)):
        images, weight = sources, 1.0
        for plane in (plane for plane, used in zip(planes, chosen, strict=True) if used):
            images, weight = plane.mirrored(images), weight * plane.reflection
        total += weight * monopoles(points, images, wavenumber)
    return torch.from_numpy(total)


def waveguide(points, sources, wavenumber, height, reflection=1.0):
    """Return the field of monopoles between the planes z = 0 and z = height, a sum of modes.

    Both planes are rigid, or both pressure-release (reflection -1). Modes beyond the cut-off decay, so that
    points and sources must be apart across the normal, by some height / 10 for a sum of 400 modes.
    """
    points, sources = np.asarray(points, float), np.asarray(sources, float)
    apart = np.linalg.norm(points[:, None, :2] - sources[:, :2], axis=-1)
    profile = np.cos if reflection == 1 else np.sin
    total = np.zeros(apart.shape, complex)
    for n in range(400):
        vertical = n * math.pi / height
        along = np.sqrt(complex(wavenumber**2 - vertical**2))
        shape = profile(vertical * points[:, None, 2]) * profile(vertical * sources[:, 2])
        total += (2 if n else 1) * shape * 0.25j / height * hankel1(0, along * apart)
    return torch.from_numpy(total)


def pistons_in_panel(points, array, wavenumber, radius):
    """Return the pressure (P, M) [Pa] of discs in a rigid panel, of unit drive, by the Rayleigh integral."""
    (normal,) = np.unique(array.normals.numpy(), axis=0)
    strengths = strengths_of(array)
    return 8 * math.pi * strengths * piston_field(points, array.positions, wavenumber, radius, tuple(normal))
