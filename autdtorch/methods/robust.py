"""A drive that holds at all places of the obstacles in a ball, with its certificate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from autdtorch.methods.base import Method
from autdtorch.methods.gradient import GradientAscent
from autdtorch.methods.run import require_method, run
from autdtorch.objectives.bound import joint_bound
from autdtorch.objectives.goals import WEAKEST_FOCUS, WeakestFocus
from autdtorch.objectives.objective import SimulatedObjective
from autdtorch.objectives.pose_ball import Certificate, PoseBall
from autdtorch.objectives.scenarios import Scenarios
from autdtorch.utils.array_types import REAL
from autdtorch.utils.text import counted
from autdtorch.utils.validation import integer_at_least, positive, require_kind

_CLOSE = 5e-3  # relative distance of the worst place in the ball to the score of the scenarios, at the end


@dataclass(frozen=True, eq=False)
class RobustDrive:
    """A drive for all places in a ball.

    Attributes:
        drive: (M,).
        nominal: its score without shift [Pa].
        certificate: its proven least score in the ball, and its worst places.
        bound: no drive has a higher score at all places in the ball [Pa].
        scenarios: the places that it was made for; the first is the scene's.
    """

    drive: torch.Tensor
    nominal: float
    certificate: Certificate
    bound: float
    scenarios: Scenarios

    def __repr__(self) -> str:
        least, places = self.certificate.least, counted(len(self.scenarios), "place")
        pressures = f"at least {least:.4g} of at most {self.bound:.4g} Pa, nominal {self.nominal:.4g} Pa"
        return f"RobustDrive({pressures}, {places})"


def robust_drive(
    ball: PoseBall,
    goal: WeakestFocus = WEAKEST_FOCUS,
    method: Method | None = None,
    rounds: int = 12,
    seed: int = 0,
    effort: float = 5.0,
) -> RobustDrive:
    """Return the drive of the highest certificate: the worst places join the scenarios, round by round.

    Each round maximises the goal at all places so far, from the last drive on, and asks the ball for the
    worst places of the drive. It ends when these are no worse than the score, by 0.5 %.

    Args:
        ball: of places.
        goal: to maximise at the worst place.
        method: that maximises; None for `GradientAscent`.
        rounds: most rounds, >= 1.
        seed: of the method, >= 0.
        effort: of the bound, > 0; more lowers it (`focus_bound`).

    Raises:
        ValueError: as `PoseBall.certificate`.
    """
    require_kind("ball", ball, PoseBall)
    method = GradientAscent() if method is None else method
    require_method(method)
    rounds, seed = integer_at_least("rounds", rounds, 1), integer_at_least("seed", seed, 0)
    effort = positive("effort", effort)
    scene, offsets = ball.propagator.scene, torch.zeros(0, 3, **REAL)
    new = torch.zeros(1, 3, **REAL)
    best: RobustDrive | None = None
    start: torch.Tensor | None = None
    for number in range(rounds):
        offsets = torch.cat([offsets, new])
        matrices = ball.transfer_matrix(offsets)
        places = [scene.moved(tuple(offset)) for offset in offsets.tolist()]
        objectives = map(SimulatedObjective.of_matrix, places, matrices)
        scenarios = Scenarios(objectives)
        solution = run(method, scenarios, seed=seed + number, goal=goal, start=start)
        start = solution.drive[0]
        certificate = ball.certificate(start, goal)
        if best is None or certificate.least > best.certificate.least:
            nominal = float(scenarios.scores(start, goal)[0])
            best = RobustDrive(start, nominal, certificate, 0.0, scenarios)
        if certificate.worst >= (1 - _CLOSE) * float(solution.score[0]):
            break
        new = certificate.offsets
    assert best is not None
    # places only join: the last matrices are those of all rounds
    bound = joint_bound(matrices.cpu().numpy(), goal.wanted(matrices.shape[1]), effort)
    return replace(best, bound=bound)
