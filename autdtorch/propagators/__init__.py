"""Propagators: the pressure of a scene by exact sums, by FDTD in boxes or by FDTD on the whole domain."""

from autdtorch.propagators.differentiable import cell_centers, differentiable_field
from autdtorch.propagators.free_space import FreeSpacePropagator
from autdtorch.propagators.make_propagator import CACHE_VARIABLE, make_propagator
from autdtorch.propagators.simulated import Propagator, SimulatedPropagator, SteadyStateWarning
from autdtorch.propagators.simulation import Run
from autdtorch.propagators.volume import volume_field

__all__ = [
    "CACHE_VARIABLE",
    "FreeSpacePropagator",
    "Propagator",
    "Run",
    "SimulatedPropagator",
    "SteadyStateWarning",
    "cell_centers",
    "differentiable_field",
    "make_propagator",
    "volume_field",
]
