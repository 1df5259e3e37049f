from . import reference
from .array import PAPER_SOURCE_STRENGTH, TransducerArray
from .drive import amplitudes_of, drive_from_phases, focus_phases, phases_of
from .freespace import green
from .geometry import Plane, circle_points
from .metrics import FocusMetrics, focus_metrics
from .objective import Objective, SimulatedObjective, weakest_focus
from .obstacles import Box, Cylinder, Mesh, Obstacle, Sphere, VoxelMask
from .optim.base import Solution
from .optim.bayes import bayes_opt
from .optim.gabs import gabs
from .optim.lssg import lssg
from .plot import plot_convergence, plot_plane, plot_trials
from .propagator import SteadyStateWarning, cell_centers, differentiable_field, make_propagator
from .results import load_results
from .scene import Medium, OverlapWarning, Scene
from .scene_file import load_scene
from .view3d import view3d

__all__ = [
    "PAPER_SOURCE_STRENGTH",
    "Box",
    "Cylinder",
    "FocusMetrics",
    "Medium",
    "Mesh",
    "Objective",
    "Obstacle",
    "OverlapWarning",
    "Plane",
    "Scene",
    "SimulatedObjective",
    "Solution",
    "Sphere",
    "SteadyStateWarning",
    "TransducerArray",
    "VoxelMask",
    "amplitudes_of",
    "bayes_opt",
    "cell_centers",
    "circle_points",
    "differentiable_field",
    "drive_from_phases",
    "focus_metrics",
    "focus_phases",
    "gabs",
    "green",
    "load_results",
    "load_scene",
    "lssg",
    "make_propagator",
    "phases_of",
    "plot_convergence",
    "plot_plane",
    "plot_trials",
    "reference",
    "view3d",
    "weakest_focus",
]

__version__: str
