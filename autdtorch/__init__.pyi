from . import analytic, hardware
from .analytic.green import green
from .hardware.devices.openmpd_board import OpenMPDBoard
from .io.array_file import load_array
from .io.drive_file import load_drive, save_drive
from .io.field_file import save_field
from .io.scene_file import load_scene
from .methods.base import Solution
from .methods.bayes.bayes import bayes_opt
from .methods.bound import focus_bound
from .methods.gabs import gabs
from .methods.gradient import gradient_ascent
from .methods.identify import identify
from .methods.lssg import lss, lssg
from .methods.random_search import random_search
from .objectives.metrics import FocusMetrics, focus_metrics
from .objectives.perturbations import Dead, Drift, Noise, Quantised, true_pressure
from .objectives.simulated import Objective, SimulatedObjective, weakest_focus
from .plot.fields import plot_plane, plot_planes
from .plot.pareto import plot_pareto
from .plot.scaling import plot_scaling
from .plot.scene import plot_scene
from .plot.trials import plot_convergence, plot_trials
from .plot.view3d import animate3d, view3d
from .propagators import (
    SteadyStateWarning,
    cell_centers,
    differentiable_field,
    make_propagator,
    volume_field,
)
from .propagators.estimate import Estimate, estimate
from .scene.arrays import PAPER_SOURCE_STRENGTH, TransducerArray
from .scene.drive import amplitudes_of, drive_from_phases, focus_phases, phases_of
from .scene.geometry import Plane, circle_points
from .scene.medium import Medium
from .scene.obstacles import Box, Cylinder, Mesh, Obstacle, Sphere, VoxelMask
from .scene.scene import OverlapWarning, ScaleWarning, Scene
from .study.results_file import load_results
from .study.sweeps import Sweep, collect_results

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
    "analytic",
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
    "save_drive",
    "save_field",
    "true_pressure",
    "view3d",
    "volume_field",
    "weakest_focus",
]

__version__: str
