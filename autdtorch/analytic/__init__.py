"""Exact solutions of the Helmholtz equation to check simulations against.

Convention e^{-i w t}, outgoing e^{+ikr}/r. Every point source is that of `freespace.green`, e^{ikr} / (4 pi
r); times 4 pi S it is a source of strength S. Ratios are of the obstacle over the medium: density_ratio is
rho_1 / rho, speed_ratio is c_1 / c.
"""

from autdtorch.analytic.green import green
from autdtorch.analytic.layers import slab_coefficients, step_coefficients
from autdtorch.analytic.piston import piston_directivity, piston_field, piston_on_axis
from autdtorch.analytic.planes import fluid_half_space, fluid_slab, rigid_plane, soft_plane
from autdtorch.analytic.sphere import fluid_sphere, rigid_sphere, soft_sphere

__all__ = [
    "fluid_half_space",
    "fluid_slab",
    "fluid_sphere",
    "green",
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
