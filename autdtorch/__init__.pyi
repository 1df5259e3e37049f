from . import analytic, hardware
from .analytic.green import green
from .hardware.devices.openmpd import OpenMPDBoard
from .io.array_file import load_array
from .io.calibration_file import load_calibration, save_calibration
from .io.drive_file import load_drive, load_sequence, save_drive, save_sequence
from .io.field_file import save_field
from .io.picture_file import load_picture, save_picture
from .io.readings_file import load_readings, save_readings
from .io.scene_file import load_scene, save_scene
from .methods.attainable import attainable
from .methods.base import Method, State
from .methods.bayes.focus_problem import FocusProblem
from .methods.bayes.gaussian_process import PhasorKernel
from .methods.bayes_opt import BayesOpt
from .methods.calibration.calibrate import calibrate
from .methods.calibration.calibration import Calibration
from .methods.functions import (
    bayes_opt,
    bo_foci,
    gabs,
    gradient_ascent,
    identify,
    lss,
    lssg,
    phase_stepping,
    random_search,
)
from .methods.gabs import GABS
from .methods.gradient import GradientAscent
from .methods.holography.holography import Holography, holography
from .methods.holography.sequence import drive_sequence, sequence_along
from .methods.identify import Identify
from .methods.lssg import LSS, LSSG
from .methods.phase_stepping import PhaseStepping
from .methods.prior import Prior
from .methods.problem import Problem
from .methods.random_search import RandomSearch
from .methods.robust import robust_drive
from .methods.run import run
from .methods.solution import Solution
from .methods.state_file import load_state, save_state
from .objectives.bound import focus_bound
from .objectives.force_sensor import ForceSensor
from .objectives.forces import ForceObjective, Levitate, Push, Trap
from .objectives.goals import Goal, MeanPressure, TargetPressures, WeakestFocus
from .objectives.haptics import HapticMetrics, haptic_metrics
from .objectives.metrics import FocusMetrics, focus_metrics
from .objectives.objective import Objective, SimulatedObjective, weakest_focus
from .objectives.over_scenes import OverScenes
from .objectives.perturbations import CameraNoise, Drift, FailedTransducers, Noise, Quantised, true_pressure
from .objectives.pose_ball import PoseBall
from .objectives.quiet import Contrast, QuietPoints, SeenPoints
from .objectives.readings import Readings
from .objectives.scenarios import Scenarios
from .plot.calibration_figure import plot_calibration
from .plot.cost_figures import plot_pareto, plot_scaling
from .plot.explore import explore
from .plot.haptics_figure import plot_haptics
from .plot.plane_maps import plot_force, plot_plane, plot_planes
from .plot.scene_figure import plot_scene
from .plot.trials import plot_convergence, plot_poses, plot_trials
from .plot.view3d import animate3d, view3d
from .propagators import SteadyStateWarning, cell_centers, differentiable_field, make_propagator, volume_field
from .propagators.equilibrium import equilibrium
from .propagators.estimate import Estimate, estimate
from .propagators.field_forces import radiation_stress
from .propagators.gorkov import gorkov
from .propagators.nearby_poses import NearbyPoses
from .propagators.tmatrix.force import force_matrices, radiation_force, radiation_torque
from .propagators.tmatrix.tmatrix import TMatrix, TMatrixCluster
from .scene.arrays import PAPER_SOURCE_STRENGTH, TransducerArray
from .scene.drive import amplitudes_of, drive_from_phases, focus_phases, phases_of
from .scene.geometry import Plane, circle_points, polyline_points, sphere_points
from .scene.medium import Medium, porous
from .scene.obstacles import Box, Cylinder, Mesh, Obstacle, Sphere, VoxelMask
from .scene.particle import Particle
from .scene.reflectors import Reflector
from .scene.scene import OverlapWarning, ScaleWarning, Scene
from .scene.sequence import Sequence, modulated, silenced
from .study.results_file import load_results
from .study.sweeps import Sweep, collect_results

__all__ = [
    "GABS",
    "LSS",
    "LSSG",
    "PAPER_SOURCE_STRENGTH",
    "BayesOpt",
    "Box",
    "Calibration",
    "CameraNoise",
    "Contrast",
    "Cylinder",
    "Drift",
    "Estimate",
    "FailedTransducers",
    "FocusMetrics",
    "FocusProblem",
    "ForceObjective",
    "ForceSensor",
    "Goal",
    "GradientAscent",
    "HapticMetrics",
    "Holography",
    "Identify",
    "Levitate",
    "MeanPressure",
    "Medium",
    "Mesh",
    "Method",
    "NearbyPoses",
    "Noise",
    "Objective",
    "Obstacle",
    "OpenMPDBoard",
    "OverScenes",
    "OverlapWarning",
    "Particle",
    "PhaseStepping",
    "PhasorKernel",
    "Plane",
    "PoseBall",
    "Prior",
    "Problem",
    "Push",
    "Quantised",
    "QuietPoints",
    "RandomSearch",
    "Readings",
    "Reflector",
    "ScaleWarning",
    "Scenarios",
    "Scene",
    "SeenPoints",
    "Sequence",
    "SimulatedObjective",
    "Solution",
    "Sphere",
    "State",
    "SteadyStateWarning",
    "Sweep",
    "TMatrix",
    "TMatrixCluster",
    "TargetPressures",
    "TransducerArray",
    "Trap",
    "VoxelMask",
    "WeakestFocus",
    "amplitudes_of",
    "analytic",
    "animate3d",
    "attainable",
    "bayes_opt",
    "bo_foci",
    "calibrate",
    "cell_centers",
    "circle_points",
    "collect_results",
    "differentiable_field",
    "drive_from_phases",
    "drive_sequence",
    "equilibrium",
    "estimate",
    "explore",
    "focus_bound",
    "focus_metrics",
    "focus_phases",
    "force_matrices",
    "gabs",
    "gorkov",
    "gradient_ascent",
    "green",
    "haptic_metrics",
    "hardware",
    "holography",
    "identify",
    "load_array",
    "load_calibration",
    "load_drive",
    "load_picture",
    "load_readings",
    "load_results",
    "load_scene",
    "load_sequence",
    "load_state",
    "lss",
    "lssg",
    "make_propagator",
    "modulated",
    "phase_stepping",
    "phases_of",
    "plot_calibration",
    "plot_convergence",
    "plot_force",
    "plot_haptics",
    "plot_pareto",
    "plot_plane",
    "plot_planes",
    "plot_poses",
    "plot_scaling",
    "plot_scene",
    "plot_trials",
    "polyline_points",
    "porous",
    "radiation_force",
    "radiation_stress",
    "radiation_torque",
    "random_search",
    "robust_drive",
    "run",
    "save_calibration",
    "save_drive",
    "save_field",
    "save_picture",
    "save_readings",
    "save_scene",
    "save_sequence",
    "save_state",
    "sequence_along",
    "silenced",
    "sphere_points",
    "true_pressure",
    "view3d",
    "volume_field",
    "weakest_focus",
]

__version__: str
