from . import hardware, reference
from .array import PAPER_SOURCE_STRENGTH, TransducerArray
from .array_file import load_array
from .collect import Sweep, collect_results
from .conditions import Dead, Drift, Noise, Quantised, true_pressure
from .drive import amplitudes_of, drive_from_phases, focus_phases, phases_of
from .drive_file import load_drive, save_drive
from .field_file import save_field
from .freespace import green
from .geometry import Plane, circle_points
from .medium import Medium
from .metrics import FocusMetrics, focus_metrics
from .objective import Objective, SimulatedObjective, weakest_focus
from .obstacles import Box, Cylinder, Mesh, Obstacle, Sphere, VoxelMask
from .openmpd_board import OpenMPDBoard
from .optim.base import Solution
from .optim.bayes import bayes_opt
from .optim.bound import focus_bound
from .optim.gabs import gabs
from .optim.gradient import gradient_ascent
from .optim.identify import identify
from .optim.lssg import lss, lssg
from .optim.random_search import random_search
from .plot import (
    plot_convergence,
    plot_pareto,
    plot_plane,
    plot_planes,
    plot_scaling,
    plot_scene,
    plot_trials,
)
from .propagator import (
    SteadyStateWarning,
    cell_centers,
    differentiable_field,
    make_propagator,
    volume_field,
)
from .rendering import animate3d, view3d
from .results import load_results
from .scene import OverlapWarning, ScaleWarning, Scene
from .scene_file import load_scene
from .simulation_estimate import Estimate, estimate

__all__ = [
    "PAPER_SOURCE_STRENGTH",
    "Box",
    "Cylinder",
    "Dead",
    "Drift",
    "Estimate",
    "FocusMetrics",
    "Medium",
    "Mesh",
    "Noise",
    "Objective",
    "Obstacle",
    "OpenMPDBoard",
    "OverlapWarning",
    "Plane",
    "Quantised",
    "ScaleWarning",
    "Scene",
    "SimulatedObjective",
    "Solution",
    "Sphere",
    "SteadyStateWarning",
    "Sweep",
    "TransducerArray",
    "VoxelMask",
    "amplitudes_of",
    "animate3d",
    "bayes_opt",
    "cell_centers",
    "circle_points",
    "collect_results",
    "differentiable_field",
    "drive_from_phases",
    "estimate",
    "focus_bound",
    "focus_metrics",
    "focus_phases",
    "gabs",
    "gradient_ascent",
    "green",
    "hardware",
    "identify",
    "load_array",
    "load_drive",
    "load_results",
    "load_scene",
    "lss",
    "lssg",
    "make_propagator",
    "phases_of",
    "plot_convergence",
    "plot_pareto",
    "plot_plane",
    "plot_planes",
    "plot_scaling",
    "plot_scene",
    "plot_trials",
    "random_search",
    "reference",
    "save_drive",
    "save_field",
    "true_pressure",
    "view3d",
    "volume_field",
    "weakest_focus",
]

__version__: str
