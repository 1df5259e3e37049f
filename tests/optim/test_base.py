import subprocess
import sys

import pytest
import torch

from autdtorch.methods.base import Ledger, trial_seed
from autdtorch.objectives.simulated import weakest_focus
from autdtorch.scene.drive import drive_from_phases


class Broken:
    """An objective whose sensor gives whatever it is told to."""

    def __init__(self, objective, pressure):
        self.scene = objective.scene
        self.evaluations = 0
        self._pressure = pressure

    def __call__(self, drive):
        return self._pressure


def random_drives(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return drive_from_phases(6.3 * torch.rand(shape, dtype=torch.float64, generator=generator))


def test_ledger_keeps_the_best_drive_of_every_trial(make_objective, random_matrix):
    objective = make_objective(random_matrix(3, 4, 0))
    ledger = Ledger(objective, 2, weakest_focus)
    drives = [random_drives(2, 5, 4, seed=seed) for seed in range(3)]
    scores = torch.cat([ledger.evaluate(drive) for drive in drives], dim=1)
    solution = ledger.solution()
    assert torch.equal(solution.score, scores.max(dim=1).values)
    assert torch.equal(solution.history, scores.cummax(dim=1).values)
    assert solution.evaluations.tolist() == [15, 15]
    assert objective.evaluations == 30
    everything = torch.cat(drives, dim=1)
    for trial in range(2):
        assert torch.equal(solution.drive[trial], everything[trial, scores[trial].argmax()])
    assert torch.equal(solution.pressure, objective(solution.drive))


def test_score_is_a_separate_function(make_objective, random_matrix):
    ledger = Ledger(make_objective(random_matrix(3, 4, 0)), 1, lambda pressure: pressure.mean(dim=-1))
    ledger.evaluate(random_drives(1, 6, 4))
    solution = ledger.solution()
    assert torch.equal(solution.score, solution.pressure.mean(dim=-1))


@pytest.mark.parametrize(
    ("pressure", "message"),
    [
        (torch.tensor([[1.0, torch.nan], [1.0, 1.0]]), "pressure of the objective: .*nan.* Pa; every entry"),
        (torch.ones(2, 3), r"pressure of the objective: shape \(2, 3\); must be \(2, 2\)"),
        (torch.ones(2, 2, dtype=torch.complex128), "pressure of the objective: .*real"),
    ],
    ids=["nan", "shape", "complex"],
)
def test_broken_sensor_is_reported(make_objective, random_matrix, pressure, message):
    ledger = Ledger(Broken(make_objective(random_matrix(2, 4, 0)), pressure), 1, weakest_focus)
    with pytest.raises(ValueError, match=message):
        ledger.evaluate(random_drives(1, 2, 4))


def test_score_of_the_wrong_shape_is_reported(make_objective, random_matrix):
    ledger = Ledger(make_objective(random_matrix(2, 4, 0)), 1, lambda pressure: pressure)
    with pytest.raises(ValueError, match=r"score: shape \(1, 2, 2\); must be \(1, 2\)"):
        ledger.evaluate(random_drives(1, 2, 4))


def test_seeds_of_trials_are_all_different():
    seeds = {trial_seed(seed, trial) for seed in range(20) for trial in range(50)}
    assert len(seeds) == 1000
    assert all(0 <= seed < 2**63 for seed in seeds)


def test_importing_the_methods_loads_no_numba():
    code = (
        "import sys, autdtorch.methods.bayes.bayes, autdtorch.methods.gabs, autdtorch.methods.lssg;"
        "sys.exit(any(name.split('.')[0] == 'numba' for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
