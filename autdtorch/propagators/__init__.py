"""Propagators: the pressure of a scene by exact sums, by FDTD in boxes or by FDTD on the whole domain."""

from autdtorch.propagators.cache import CACHE_VARIABLE as CACHE_VARIABLE
from autdtorch.propagators.differentiable import cell_centers as cell_centers
from autdtorch.propagators.differentiable import differentiable_field as differentiable_field
from autdtorch.propagators.free_space import FreeSpacePropagator as FreeSpacePropagator
from autdtorch.propagators.make_propagator import make_propagator as make_propagator
from autdtorch.propagators.operator_propagator import OperatorPropagator as OperatorPropagator
from autdtorch.propagators.simulated import Propagator as Propagator
from autdtorch.propagators.simulated import SimulatedPropagator as SimulatedPropagator
from autdtorch.propagators.simulated import SteadyStateWarning as SteadyStateWarning
from autdtorch.propagators.simulation import Run as Run
from autdtorch.propagators.volume import volume_field as volume_field
