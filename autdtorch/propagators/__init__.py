"""Propagators: the pressure of a scene by exact sums, by FDTD in boxes or by FDTD on the whole domain."""

from autdtorch.propagators.differentiable import cell_centers as cell_centers
from autdtorch.propagators.differentiable import differentiable_field as differentiable_field
from autdtorch.propagators.free_space import FreeSpacePropagator as FreeSpacePropagator
from autdtorch.propagators.make_propagator import make_propagator as make_propagator
from autdtorch.propagators.notices import SteadyStateWarning as SteadyStateWarning
from autdtorch.propagators.propagator import Propagator as Propagator
from autdtorch.propagators.propagator import volume_field as volume_field
from autdtorch.propagators.simulated import SimulatedPropagator as SimulatedPropagator
from autdtorch.propagators.simulation import Run as Run
from autdtorch.propagators.store import CACHE_VARIABLE as CACHE_VARIABLE
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator as TMatrixPropagator
