"""The report of a study: the paper's figures and claims with our numbers, and the gaps to the bound."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from autdtorch.methods.catalogue import label_of
from autdtorch.scene.scene import Scene
from autdtorch.study.report import tables
from autdtorch.study.report.claims import BO, GABS, judge_claims
from autdtorch.study.report.document import as_page, rendered
from autdtorch.study.report.figures import draw_figures
from autdtorch.study.results import StudyResult, summary_rows
from autdtorch.study.results_file import RESULTS_FILE
from autdtorch.study.statistics import FEWEST_TRIALS
from autdtorch.study.trial_file import TRIALS_FILE

REPORT_FILE = "report.md"
HTML_FILE = "report.html"

_FEW_TRIALS = 20  # with fewer, the spread of a method is not well known


def write_report(
    results: StudyResult,
    scenes: Mapping[str, Scene],
    folder: str | os.PathLike[str],
    command: str,
    seeds: Sequence[int] = (),
) -> Path:
    """Write `report.md` and its figures, and both as one file `report.html`, whose path is returned.

    Args:
        results: results to report.
        scenes: the scenes of `results`, by the same names.
        folder: folder for the report and its figures; made if it does not exist.
        command: command line that repeats the study.
        seeds: seeds of the studies that `results` were merged from; empty for a single study in `folder`.

    Raises:
        OSError: the folder cannot be made or written.
        ValueError: a scene of `results` is missing in `scenes`.
    """
    if missing := results.scenes.keys() - scenes.keys():
        raise ValueError(f"scenes: none for {sorted(missing)}; must have every scene of the results")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    scenes = {name: scenes[name] for name in results.scenes}
    with tempfile.TemporaryDirectory(dir=folder, prefix=".report-") as new:
        text = _markdown(results, scenes, Path(new), command, seeds)
        (Path(new) / REPORT_FILE).write_text(text, encoding="utf-8")
        (Path(new) / HTML_FILE).write_text(as_page(text, Path(new)), encoding="utf-8")
        # A file replaces an older one, or a link: nothing is written through a link.
        for file in Path(new).iterdir():
            file.replace(folder / file.name)
    return folder / HTML_FILE


def _markdown(
    results: StudyResult, scenes: Mapping[str, Scene], folder: Path, command: str, seeds: Sequence[int]
) -> str:
    counts: dict[str, list[int]] = {}
    for scene in results.scenes.values():
        for name, method in scene.methods.items():
            counts.setdefault(name, []).append(method.trials)
    judged = judge_claims(results)
    tolerances = {scene.simulation.tolerance for scene in results.scenes.values()}
    return rendered(
        "study.md",
        command=command,
        provenance=results.provenance,
        versions=", ".join(f"{name} {version}" for name, version in results.provenance.versions.items()),
        seeds=seeds,
        trials=", ".join(f"{label_of(name)} {tables.extent(numbers)}" for name, numbers in counts.items()),
        few=[label_of(name) for name in (BO, GABS) if max(counts.get(name, [_FEW_TRIALS])) < _FEW_TRIALS],
        fewest_trials=FEWEST_TRIALS,
        figures=draw_figures(results, scenes, folder),
        summary=summary_rows(results),
        claims=tables.claim_rows(judged),
        claims_in_all=len(judged),
        claims_without_data=[n for n, (_, verdict) in enumerate(judged, start=1) if verdict is None],
        gaps=tables.gap_rows(results),
        near=tables.NEAR,
        baseline=label_of(tables.BASELINE) if any(map(tables.is_baseline, counts)) else "",
        simulations=tables.simulation_rows(results),
        tolerances=[f"{one:g}" for one in sorted(one for one in tolerances if one is not None)],
        results_file=RESULTS_FILE,
        trials_file=TRIALS_FILE,
    )
