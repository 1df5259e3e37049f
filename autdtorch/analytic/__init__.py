"""Exact solutions of the Helmholtz equation, to check simulations against.

The time factor is e^{-i w t}. A point source has the field e^{ikr} / (4 pi r) of `green`; times 4 pi S it has
the source strength S. Ratios are obstacle over medium: density_ratio = rho_1 / rho, speed_ratio = c_1 / c.
They are complex where the obstacle absorbs.
"""

from autdtorch.analytic.green import green, piston_directivity, piston_field, piston_on_axis
from autdtorch.analytic.layering import slab_coefficients, step_coefficients
from autdtorch.analytic.planes import fluid_half_space, fluid_slab, impedance_plane, rigid_plane, soft_plane
from autdtorch.analytic.sphere import fluid_sphere, impedance_sphere, rigid_sphere, soft_sphere

__all__ = [
    "fluid_half_space",
    "fluid_slab",
    "fluid_sphere",
    "green",
    "impedance_plane",
    "impedance_sphere",
    "piston_directivity",
    "piston_field",
    "piston_on_axis",
    "rigid_plane",
    "rigid_sphere",
    "slab_coefficients",
    "soft_plane",
    "soft_sphere",
    "step_coefficients",
]
