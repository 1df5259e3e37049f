"""Traps and forces: bounds that no drive may exceed, and whether a trap exists as brute force decides.

Random arrays of 2 to 4 transducers around a point, a random bead, and one to six directions along which it is
to be held. Brute force takes random drives, and random steps from the best. Bounds are those of such traps,
and of single forms, with up to 16 transducers. Exits with 1 if a drive is above a bound, or if brute force
finds a trap where the answer is that there is none.
"""

from collections import Counter, defaultdict

import numpy as np

import autdtorch as at
from autdtorch.objectives.hermitian import ascended, forms_bound

OPTIONS = {
    "--questions": {"type": int, "default": 1000, "help": "number of random questions, and of random bounds"},
    "--seed": {"type": int, "default": 0, "help": "seed of both"},
}

AIR = at.Medium(density=1.204, sound_speed=343.0)
POINT = (0.0, 0.0, 0.0)
DRIVES, STEPS, ROUNDS = 4000, 100, 30


def main(questions: int, seed: int) -> int:
    rng = np.random.default_rng(seed)
    return int(check_bounds(questions, rng) + check_answers(questions, rng) > 0)


def random_objective(rng: np.random.Generator, transducers: int) -> at.ForceObjective:
    """Return a trap of one to six directions in the field of transducers 30 to 100 mm away."""
    places = rng.normal(size=(transducers, 3))
    places *= rng.uniform(0.03, 0.1, (transducers, 1)) / np.linalg.norm(places, axis=1, keepdims=True)
    array = at.TransducerArray(places, -places, source_strength=1.0)
    directions = rng.normal(size=(rng.integers(1, 7), 3))
    bead = at.Particle.of(str(rng.choice(["EPS", "water"])), float(rng.uniform(1e-4, 1.2e-3)))
    trap = at.Trap([POINT], directions, bead, displacement=float(rng.uniform(1e-4, 1e-3)))
    propagator = at.make_propagator(at.Scene(array, AIR, 40e3, [(0.0, 0.0, 0.01)]), "free_space")
    return at.ForceObjective(propagator, trap)


def random_drives(rng: np.random.Generator, count: int, transducers: int) -> np.ndarray:
    """Return drives (count, M) in the discs of amplitudes up to 1."""
    size, turn = rng.random((2, count, transducers))
    return np.sqrt(size) * np.exp(2j * np.pi * turn)


def best_by_force(rng: np.random.Generator, rows: np.ndarray, weights: np.ndarray) -> float:
    """Return the highest least form of random drives and random steps from the best."""

    def scores(drives: np.ndarray) -> np.ndarray:
        # without the amplitude: a small drive has a small score of either sign
        drives = drives / np.abs(drives).max(axis=1, keepdims=True)
        return (weights @ np.abs(rows @ drives.T) ** 2).min(axis=0)

    drives = random_drives(rng, DRIVES, rows.shape[1])
    values = scores(drives)
    best, highest = drives[values.argmax()], values.max()
    for number in range(ROUNDS):
        step = 0.5 * 0.8**number
        drives = best + step * random_drives(rng, STEPS, rows.shape[1])
        values = scores(drives)
        if values.max() > highest:
            best, highest = drives[values.argmax()], values.max()
    return float(highest)


def check_answers(count: int, rng: np.random.Generator) -> int:
    """Print how many questions brute force decides alike; return how many it contradicts."""
    answers: Counter[tuple[str, str]] = Counter()
    for number in range(count):
        objective = random_objective(rng, int(rng.integers(2, 5)))
        attained = at.attainable(objective, seed=number)
        forced = best_by_force(rng, objective.transfer_matrix.numpy(), objective.goal.weights)
        answer = {True: "exists", False: "none", None: "undecided"}[attained.answer]
        answers[answer, "exists" if forced > 0 else "none"] += 1
    for (ours, forced), times in sorted(answers.items()):
        print(f"{times} questions: {ours}; brute force: {forced}")
    return answers["none", "exists"]


def check_bounds(count: int, rng: np.random.Generator) -> int:
    """Print the gaps of drives to bounds of single forms and traps; return how many drives are above."""
    gaps, above = defaultdict(list), 0
    for _ in range(count):
        objective = random_objective(rng, int(rng.integers(2, 17)))
        rows, weights = objective.transfer_matrix.numpy(), objective.goal.weights
        # the sum of a pair of forms is twice the stiffness, their difference the force
        half, sign = len(weights) // 2, rng.choice([-1, 1])
        kinds = {
            "trap": weights,
            "stiffness along a direction": sign * (weights[:1] + weights[half : half + 1]),
            "force along a direction": weights[:1] - weights[half : half + 1],
        }
        kind = str(rng.choice(list(kinds)))
        bound = forms_bound(rows, kinds[kind])
        drives = random_drives(rng, 200, rows.shape[1])
        drives = np.stack([*drives, *ascended(rows, kinds[kind], drives[:2])])
        highest = (kinds[kind] @ np.abs(rows @ drives.T) ** 2).min(axis=0).max()
        above += highest > bound
        if bound > 0:
            gaps[kind].append(1 - max(highest, 0) / bound)
    print(f"{count} bounds: {above} exceeded")
    gaps["all"] = [gap for values in gaps.values() for gap in values]
    for kind, values in gaps.items():
        print(f"  {kind}: gap median {np.median(values):.2%}, 90 % below {np.quantile(values, 0.9):.1%}")
    return above
