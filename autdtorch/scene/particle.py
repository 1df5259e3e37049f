"""Small spheres, such as beads and drops, that sound pushes without being changed by them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from autdtorch.scene.medium import Medium
from autdtorch.utils.fluids import fluid, warn_if_in_grams
from autdtorch.utils.validation import positive, require_kind, require_one_of

GRAVITY = 9.81
"""GRAVITY: acceleration of free fall [m/s^2]."""

MATERIALS = {
    "EPS": (29.36, 1052.0),  # Marzo et al. (2015), doi:10.1038/ncomms9661, as in AcousTools 1.2
    "water": (998.2, 1482.0),  # at 20 deg C; Kaye & Laby, section 2.4.1
}
"""MATERIALS: density [kg/m^3] and sound speed [m/s] by name."""


@dataclass(frozen=True)
class Particle:
    """A sphere that is small against the wavelength.

    In air the force hardly depends on the material, as all beads and drops are far denser than air. The
    weight does.

    Attributes:
        radius: [m].
        density: [kg/m^3].
        sound_speed: [m/s]; of a solid with the bulk modulus K, (K / density)^(1/2).
    """

    radius: float
    density: float
    sound_speed: float

    def __post_init__(self) -> None:
        density, sound_speed = fluid("Particle", self.density, self.sound_speed)
        warn_if_in_grams("Particle", density, sound_speed)
        object.__setattr__(self, "radius", positive("Particle.radius", self.radius, "m"))
        object.__setattr__(self, "density", density)
        object.__setattr__(self, "sound_speed", sound_speed)

    @classmethod
    def of(cls, material: str, radius: float) -> Particle:
        """Return a particle of a material by name.

        Args:
            material: "EPS", expanded polystyrene, or "water".
            radius: [m], > 0.

        Raises:
            ValueError: an unknown material, or a radius out of range.
        """
        require_one_of("material", material, MATERIALS)
        return cls(radius, *MATERIALS[material])

    @property
    def weight(self) -> float:
        """The weight [N], without buoyancy."""
        return 4 / 3 * math.pi * self.radius**3 * self.density * GRAVITY

    def contrasts(self, medium: Medium) -> tuple[float, float]:
        """Return Gor'kov's factors f1 of compressibility and f2 of density in a medium.

        f1 = 1 - kappa / kappa_0 and f2 = 2 (r - 1) / (2 r + 1), with the ratio r of the densities; both are 1
        for a rigid and heavy particle.
        """
        require_kind("medium", medium, Medium)
        ratio = self.density / medium.density
        f1 = 1 - (medium.sound_speed / self.sound_speed) ** 2 / ratio
        return f1, 2 * (ratio - 1) / (2 * ratio + 1)


BEAD = Particle.of("EPS", 0.5e-3)
"""BEAD: the usual bead of acoustic levitation, of 1 mm diameter."""
