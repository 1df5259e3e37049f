"""The findings of a study in a few plain sentences, computed from its results."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from autdtorch.io.goal_section import goal_label
from autdtorch.methods.catalogue import label_of
from autdtorch.study.report.claims import Claim, Verdict
from autdtorch.study.report.tables import competitors, median_score
from autdtorch.study.results import SceneResult, StudyResult
from autdtorch.study.statistics import has_shares
from autdtorch.utils.text import in_digits, in_percent

MOST_NAMED = 4  # scenes, groups or gaps that a sentence names; more are counted

LEVEL = 0.01  # methods are level with the best if their score is lower by less than this share of it
_EQUAL = 0.005  # smaller changes by obstacles would be shown as 0 %


class _Best(NamedTuple):
    """The best score in a scene, and the labels of the methods that are level with it, best first."""

    score: float
    labels: tuple[str, ...]


def findings(results: StudyResult, judged: Sequence[tuple[Claim, Verdict | None]]) -> list[str]:
    """Return one sentence each on the best methods, the bound, the obstacles and the paper's claims.

    Baselines are left out where there are other methods. The last sentence is left out where the results
    have no data on any claim. One before it names methods that gained nothing, if there are any.
    """
    best = {name: _best(scene) for name, scene in results.scenes.items()}
    verdicts = [verdict for _, verdict in judged if verdict is not None]
    sentences = [_winners(results, best), _nearness(results, best), _cost_of_obstacles(results, best)]
    sentences += [_without_gain(results)] if any(map(_stuck, results.scenes.values())) else []
    sentences += [_verdicts(verdicts, len(judged))] if verdicts else []
    return [sentence.replace(" %", "\N{NO-BREAK SPACE}%") for sentence in sentences]


def gaps(results: StudyResult) -> list[str]:
    """Return the methods that some scenes have and others lack, one text for each such scene."""
    every = list(dict.fromkeys(name for scene in results.scenes.values() for name in scene.methods))
    lacking = {
        name: [label_of(method) for method in every if method not in scene.methods]
        for name, scene in results.scenes.items()
    }
    texts = [f"{listed(labels)} in {name}" for name, labels in lacking.items() if labels]
    return texts if len(texts) <= MOST_NAMED else [*texts[:MOST_NAMED], f"{len(texts) - MOST_NAMED} more"]


def listed(words: Iterable[str]) -> str:
    """Return words as "a", "a and b" or "a, b and c"."""
    *others, last = words
    return f"{', '.join(others)} and {last}" if others else last


def _best(scene: SceneResult) -> _Best:
    scores = {label_of(name): median_score(method) for name, method in competitors(scene).items()}
    ranked = sorted(scores, key=lambda label: -scores[label])
    top = scores[ranked[0]]
    return _Best(top, tuple(label for label in ranked if top - scores[label] <= LEVEL * abs(top)))


def _winners(results: StudyResult, best: Mapping[str, _Best]) -> str:
    """Return the sentence on the best scores, and the methods that reached them."""
    scenes = results.scenes
    goals = {goal_label(scene.goal) for scene in scenes.values()}
    goal = goals.pop() if len(goals) == 1 else "of each scene"
    median = any(method.trials > 1 for scene in scenes.values() for method in scene.methods.values())
    every = {label_of(method) for scene in scenes.values() for method in competitors(scene)}
    groups: dict[tuple[str, ...], list[str]] = {}
    for name, top in best.items():
        groups.setdefault(top.labels, []).append(name)
    largest_first = sorted(groups, key=lambda labels: -len(groups[labels]))
    level = f" (less than {100 * LEVEL:.0f} % apart)"
    parts = [
        f"{_scores(groups[labels], scenes, best)}, by {listed(labels)}{level if len(labels) > 1 else ''}"
        for labels in largest_first[:MOST_NAMED]
    ]
    if rest := sum(len(groups[labels]) for labels in largest_first[MOST_NAMED:]):
        parts.append(f"by other methods in {rest} more scenes")
    kind = f"{'best ' if len(every) > 1 else ''}{'median ' if median else ''}score"
    single = "" if median or len(every) == 1 else " Single trials do not rank methods with random choices."
    return f"For the goal {goal}, the {kind} is {'; '.join(parts)}.{single}"


def _scores(names: Sequence[str], scenes: Mapping[str, SceneResult], best: Mapping[str, _Best]) -> str:
    """Return the best scores of scenes, or the number of scenes and the range of the scores."""
    if len(names) <= MOST_NAMED:
        return _in_scenes({name: scenes[name].in_unit(in_digits(best[name].score, 3)) for name in names})
    where = f"in {len(names)} of {len(scenes)} scenes"
    if any(not _comparable(scenes[name], scenes[names[0]]) for name in names):
        return f"reached {where}"
    low, high = (in_digits(edge(best[name].score for name in names), 3) for edge in (min, max))
    return f"{low} to {scenes[names[0]].in_unit(high)} {where}"


def _in_scenes(texts: Mapping[str, str]) -> str:
    """Return the text of each scene as "1 Pa in a and b, and 2 Pa in c"."""
    groups: dict[str, list[str]] = {}
    for name, text in texts.items():
        groups.setdefault(text, []).append(name)
    *others, last = (f"{text} in {listed(names)}" for text, names in groups.items())
    return f"{', '.join(others)}, and {last}" if others else last


def _nearness(results: StudyResult, best: Mapping[str, _Best]) -> str:
    """Return the sentence on the distance of the best scores from the certified bound."""
    scenes = results.scenes
    shares = [best[name].score / scene.bound for name, scene in scenes.items() if has_shares(scene.bound)]
    parts = [f"{_range(shares)} % of the certified upper bound"] if shares else []
    below = [
        f"{scene.in_unit(f'{scene.bound - best[name].score:.3g}')} below the certified upper bound in {name}"
        for name, scene in scenes.items()
        if math.isfinite(scene.bound) and not has_shares(scene.bound)
    ]
    parts += below[:MOST_NAMED]
    if not parts:
        return "No upper bound on the score is known, so a better drive may exist."
    unknown = len(scenes) - len(shares) - len(below)
    rest = f" (not known for {unknown} of {len(scenes)} scenes)" if unknown else ""
    subject = "This score is" if len(scenes) == 1 else "These scores are"
    return f"{subject} {listed(parts)}{rest}; no drive can exceed the bound."


def _range(shares: Sequence[float]) -> str:
    """Return the least and the largest share in percent."""
    low, high = (in_percent(share) if share > 0 else "0" for share in (min(shares), max(shares)))
    return low if low == high else f"{low} to {high}"


def _cost_of_obstacles(results: StudyResult, best: Mapping[str, _Best]) -> str:
    """Return the sentence on the scores with obstacles against those without."""
    with_obstacles = {name: scene for name, scene in results.scenes.items() if scene.obstacles}
    if not with_obstacles:
        return "No scene has obstacles."
    for empty_name, empty in results.scenes.items():
        same = {
            name: scene
            for name, scene in with_obstacles.items()
            if _comparable(scene, empty) and scene.transfer_matrix.shape == empty.transfer_matrix.shape
        }
        if empty.obstacles == 0 and best[empty_name].score > 0 and same:
            break
    else:
        return "What the obstacles cost is not known: no scene of equal goal, array and foci is without them."
    changes = {name: best[name].score / best[empty_name].score - 1 for name in same}
    if len(changes) <= MOST_NAMED:
        shown = _in_scenes({name: _change(change) for name, change in changes.items()})
    else:
        low, high = sorted(changes.values())[:: len(changes) - 1]
        shown = f"from {_change(low)} to {_change(high)} in {len(changes)} scenes"
    hardest = _hardest_hit(same, empty)
    return f"Against {empty_name}, which has no obstacles, the best score is {shown}{hardest}."


def _comparable(scene: SceneResult, other: SceneResult) -> bool:
    return scene.goal == other.goal and scene.unit == other.unit


def _hardest_hit(scenes: Mapping[str, SceneResult], empty: SceneResult) -> str:
    """Return which method loses most by obstacles, or "" if there is only one, or none that loses."""
    without = {name: median_score(method) for name, method in competitors(empty).items()}
    shares = {
        (label_of(name), scene_name): median_score(method) / without[name] - 1
        for scene_name, scene in scenes.items()
        for name, method in competitors(scene).items()
        if without.get(name, 0.0) > 0
    }
    if len({label for label, _ in shares}) < 2 or min(shares.values()) > -_EQUAL:
        return ""
    label, name = min(shares, key=lambda key: shares[key])
    return f"; {label} loses most, {-100 * shares[label, name]:.0f} % in {name}"


def _change(share: float) -> str:
    if abs(share) < _EQUAL:
        return "unchanged"
    return f"{100 * abs(share):.{0 if abs(share) >= 0.1 else 1}f} % {'lower' if share < 0 else 'higher'}"


def _stuck(scene: SceneResult) -> list[str]:
    """Return the labels of the methods none of whose trials found a better drive than its first."""
    return [
        label_of(name)
        for name, method in competitors(scene).items()
        if method.solution.evaluations.min() > 1
        and (method.solution.history[:, -1] == method.solution.history[:, 0]).all()
    ]


def _without_gain(results: StudyResult) -> str:
    """Return the sentence on the methods that found no better drive than their first."""
    labels = {name: _stuck(scene) for name, scene in results.scenes.items()}
    parts = [f"{listed(stuck)} in {name}" for name, stuck in labels.items() if stuck]
    more = [f"{len(parts) - MOST_NAMED} more"] if len(parts) > MOST_NAMED else []
    lssg, why = label_of("lssg"), ""
    if any(lssg in stuck for stuck in labels.values()):
        # as where symmetry makes all foci equal, and a change of one offset makes one of them weaker
        why = f": {lssg} changes one offset at a time, and no single change raised the score"
    return f"No better drive than the first was found by {'; '.join(parts[:MOST_NAMED] + more)}{why}."


def _verdicts(verdicts: Sequence[Verdict], claims: int) -> str:
    held = sum(verdict.holds for verdict in verdicts)
    unclear = sum(not verdict.clear for verdict in verdicts)
    parts = [f"{_are(held)} reproduced", f"{_are(len(verdicts) - held)} not reproduced"]
    if len(verdicts) < claims:
        parts.append(f"{_are(claims - len(verdicts))} not judged for lack of data")
    doubt = f"; of these verdicts, {_are(unclear)} not clear" if unclear else ""
    return f"Of the paper's {claims} claims, {listed(parts)}{doubt}."


def _are(count: int) -> str:
    return f"{count or 'none'} {'is' if count <= 1 else 'are'}"
