"""The goals that a config, a result or a command may name."""

from autdtorch.objectives.forces import ForceGoal, Levitate, Push, Trap
from autdtorch.objectives.goals import Goal, MeanPressure, TargetPressures, WeakestFocus
from autdtorch.objectives.over_scenes import OverScenes
from autdtorch.objectives.quiet import Contrast, QuietPoints, SeenPoints

_PRESSURES = WeakestFocus, MeanPressure, TargetPressures, QuietPoints, SeenPoints, Contrast, OverScenes
GOALS: dict[str, type[Goal] | type[ForceGoal]] = {
    goal.name: goal for goal in (*_PRESSURES, Trap, Levitate, Push)
}
"""The goals by name, those of pressures and those of force."""
