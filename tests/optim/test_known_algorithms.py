"""The optimisers of others in the benchmark keep to their budget, and find what is easy to find."""

import math

import pytest
import torch

import autdtorch as at

pytest.importorskip("cma", reason="in the extra optimisers")
pytest.importorskip("optuna", reason="in the extra optimisers")

from benchmarks.algorithms import answer
from benchmarks.known_algorithms import ALGORITHMS, Losses


@pytest.mark.filterwarnings("ignore")  # theirs
@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_algorithm_brings_four_transducers_into_phase_within_its_budget(make_objective, name):
    objective = make_objective(torch.ones(1, 4, dtype=torch.complex128))
    fewest, most = (20, 40) if name == "TuRBO" else (100, 160)  # TuRBO ends with a small region
    losses = Losses(objective, at.WeakestFocus(), most)
    with torch.random.fork_rng():
        drive = answer(ALGORITHMS[name], losses, seed=1, noisy=False)
    assert fewest < objective.evaluations <= most  # of whole populations
    assert objective(drive).item() > 3.6  # of 4 in phase; random phases have an rms of 2


def test_an_answer_without_noise_is_the_best_drive_seen_and_with_noise_the_recommended_one(make_objective):
    objective = make_objective(torch.ones(1, 2, dtype=torch.complex128))

    def algorithm(losses, seed):
        losses(torch.tensor([[0.0, 0.1], [0.0, 2.0]]).double().numpy())
        return torch.tensor([0.0, math.pi]).double().numpy()

    for noisy, phase in ((False, 0.1), (True, math.pi)):
        drive = answer(algorithm, Losses(objective, at.WeakestFocus(), 9), 0, noisy)
        assert at.phases_of(drive)[1].item() == pytest.approx(phase)
