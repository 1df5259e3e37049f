"""Pictures of scenes, fields and trials, as Matplotlib figures.

Every function returns a new figure and leaves pyplot's global state alone: save it with ``figure.savefig``;
a notebook shows it where it is the last expression of a cell. Data are plain arrays or tensors, or mappings
of them by the names of scenes and methods. Lengths are drawn in mm.
"""

from autdtorch.plot.fields import plot_plane, plot_planes
from autdtorch.plot.pareto import plot_pareto
from autdtorch.plot.scaling import plot_scaling
from autdtorch.plot.scene import plot_scene
from autdtorch.plot.trials import plot_convergence, plot_trials

__all__ = [
    "plot_convergence",
    "plot_pareto",
    "plot_plane",
    "plot_planes",
    "plot_scaling",
    "plot_scene",
    "plot_trials",
]
