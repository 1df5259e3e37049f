"""Findings say what a reader would else have to guess: shares that are not all, and searches without gain."""

from dataclasses import replace

import pytest
from small_scenes import small_scene

import autdtorch as at
from autdtorch.study.report.findings import findings
from autdtorch.study.results import summary_rows
from autdtorch.study.run_study import run_study
from autdtorch.utils.text import in_percent


def studied(scene, folder, **methods):
    return run_study({"a": scene}, methods, folder, solver={"method": "free_space"})


def test_a_share_is_all_only_if_it_is(tmp_path):
    assert [in_percent(share) for share in (1.0, 0.9996, 0.9, 0.123, 0.0012)] == [
        "100.0", "99.9", "90.0", "12.3", "0.12",
    ]  # fmt: skip
    results = studied(small_scene(), tmp_path, gabs=at.GABS(levels=4))
    result = results.scenes["a"]
    bound = float(result.methods["gabs"].solution.score.mean()) / 0.9997
    nearly = replace(results, scenes={"a": replace(result, bound=bound)})
    assert "99.9\N{NO-BREAK SPACE}% of the certified" in findings(nearly, [])[1]
    assert summary_rows(nearly)[1][-1].startswith("99.9 % of")


def symmetric():
    """Return a scene whose four foci a quarter turn maps on each other, as it does the array."""
    array = at.TransducerArray.grid((4, 4), 10e-3, (1e-3, 0, 0), (1, 0, 0))
    foci = at.circle_points((80e-3, 0, 0), 25e-3, 4, (1, 0, 0))
    return at.Scene(array, at.Medium(1.293, 340.0), 40e3, foci)


@pytest.mark.parametrize(("aside", "is_stuck"), [(0.0, True), (9e-3, False)])
def test_a_search_that_symmetry_keeps_at_its_start_is_named_with_the_reason(tmp_path, aside, is_stuck):
    scene = symmetric()
    points = scene.control_points.clone()
    points[0, 1] += aside  # [m], of one focus
    results = studied(replace(scene, control_points=points), tmp_path, lssg=at.LSSG(), lss=at.LSS())
    history = results.scenes["a"].methods["lssg"].solution.history[0]
    assert (history[0] == history[-1]) == is_stuck
    sentences = [each for each in findings(results, []) if each.startswith("No better drive")]
    assert len(sentences) == is_stuck
    assert not is_stuck or "found by LSSG in a: LSSG changes one offset at a time" in sentences[0]
