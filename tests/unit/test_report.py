"""The report holds every figure that it shows, and no number that is missing."""

import base64
import functools
import math
import re
import tempfile
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock
from urllib.parse import unquote

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import CUBE, small_scene

import autdtorch.study.report.study_report
from autdtorch.methods.functions import gabs, lssg
from autdtorch.objectives.bound import focus_bound
from autdtorch.objectives.goals import TargetPressures
from autdtorch.scene.geometry import Plane
from autdtorch.study.report.claims import judge_claims
from autdtorch.study.report.document import as_page, code
from autdtorch.study.report.findings import findings
from autdtorch.study.report.study_report import HTML_FILE, write_report
from autdtorch.study.report.tables import gap_rows, simulation_rows
from autdtorch.study.results import summary_rows
from autdtorch.study.run_study import run_study

PLANE = Plane(center=(20e-3, 12e-3, 12e-3), normal=(1, 0, 0), size=(20e-3, 20e-3))
# The report knows methods by name: GABS as "bayes_opt" is faster than BO.
METHODS = {
    "lssg": functools.partial(lssg, levels=4),
    "bayes_opt": functools.partial(gabs, levels=3),
    "gabs": functools.partial(gabs, levels=4),
}


def scene(plane=PLANE, obstacles=()):
    return replace(small_scene(obstacles), observation_plane=plane)


@pytest.fixture
def pictures():
    """Have a test draw the figures."""


@pytest.fixture(autouse=True)
def quick(request, monkeypatch):
    """Skip 3D pictures, which have tests elsewhere, and in most tests leave the figures blank."""
    monkeypatch.setattr(autdtorch.study.report.study_report, "rendering_problem", lambda: "no driver")
    if "pictures" not in request.fixturenames:
        request.getfixturevalue("undrawn")


def studied(scenes, **settings):
    solver = {"method": "free_space"}
    with tempfile.TemporaryDirectory() as folder:
        return run_study(scenes, METHODS, Path(folder), solver=solver, plane_spacing=2e-3, **settings)


def reported(scenes, folder, **settings):
    results = studied(scenes, **settings)
    path = write_report(results, scenes, folder, "autdtorch experiment=paper trials=3")
    assert path == folder / "report.html"
    return results, (folder / "report.md").read_text(encoding="utf-8")


def figures(report):
    return re.findall(r"!\[[^]]*\]\(([^)]+)\)", report)


def tables(report):
    blocks = re.findall(r"(?:^\|.*\|$\n?)+", report, flags=re.MULTILINE)
    return [[line[2:-2].split(" | ") for line in block.strip().splitlines()] for block in blocks]


@functools.cache
def of_seven_trials():
    return studied({"a": scene()}, trials=7)


BOTH = {"homogeneous": scene(), "three_cubes": scene(obstacles=(CUBE,))}


def test_all_figures_tables_and_findings_are_there_and_no_number_is_missing(tmp_path, pictures):
    results, report = reported(BOTH, tmp_path / "new", trials=3, config="trials: 3\n")
    shown = figures(report)
    scenes = ["fig1_homogeneous.png", "fig1_three_cubes.png"]
    assert shown == [*scenes, "fig2.png", "fig3abc.png", "fig3d.png", "fig4.png"]
    assert sorted(shown) == sorted(path.name for path in (tmp_path / "new").glob("*.png"))
    for name in shown:
        content = (tmp_path / "new" / name).read_bytes()
        assert content.startswith(b"\x89PNG")
        assert len(content) > 5_000  # an empty picture of this size has less
    assert not re.search(r"\bnan\b|\binf\b|None|[{}]", report)
    for table in tables(report):
        assert len({len(row) for row in table}) == 1
    summary, _, points, verdicts, evidence, beyond, simulation = tables(report)
    assert len(summary) == 2 + 2 * 3
    assert len(beyond) == 2 + 2 * (3 + 1)  # and the bound
    assert len(verdicts) == len(evidence) == 2 + 11
    assert len(points[0]) == 2 + 3
    assert all(row[-1].startswith(("**reproduced**", "**not reproduced**")) for row in verdicts[2:])
    assert [row[0] for row in simulation[2:]] == ["homogeneous", "three_cubes"]
    provenance = results.provenance
    command = "`autdtorch experiment=paper trials=3`"
    texts = (
        command,
        "LSSG 1, BO 3, GABS 3",
        "trials: 3",
        provenance.source_digest,
        provenance.date,
        "no driver",
    )
    assert all(text in report for text in texts)
    title, first, second, *_ = re.findall(r"^#+ .*", report, flags=re.MULTILINE)
    assert title.startswith("# ")
    assert first == "## Findings"
    assert report.index(first) < report.index(second) < report.index("| scene |") < report.index("![")
    texts = {file: text for text, file in re.findall(r"!\[([^]]*)\]\(([^)]+)\)", report)}
    metrics = results.scenes["three_cubes"].methods
    means = sorted(float(method.metrics.mean.median()) for method in metrics.values())
    for number in (means[0], means[-1]):
        assert f"{number:.3g}" in texts["fig3abc.png"]
    plane = max(float(method.plane_pressure.abs().max()) for method in metrics.values())
    assert f"{plane:.3g} Pa" in texts["fig2.png"]
    bound = results.scenes["three_cubes"].bound
    assert f"bound {bound:.3g} Pa" in texts["fig3d.png"]
    assert "4 transducers, 1 obstacle, 3 control points" in texts["fig1_three_cubes.png"]
    assert re.search(r"fastest .* in \S+ s", texts["fig4.png"])


def test_the_table_gives_the_mean_over_the_trials():
    results = studied({"a": scene()}, trials=3)
    head, lssg_row, _, gabs_row = summary_rows(results)
    metrics = results.scenes["a"].methods["gabs"].metrics
    assert head[2:5] == ["trials", "mean [Pa]", "weakest [Pa]"]
    assert gabs_row[:3] == ["a", "GABS", "3"]
    for cell, values in ((gabs_row[3], metrics.mean), (gabs_row[6], 1e6 * metrics.area)):
        shown = [float(number) for number in cell.split(" ± ")]
        half = 0.5 * 10.0 ** -decimals(cell)[0] + 1e-9  # of the last digit
        assert shown == pytest.approx([float(values.mean()), float(values.std())], abs=half)
    assert gabs_row[7] == str(1 + 3 * 4)
    mean = float(results.scenes["a"].methods["lssg"].metrics.mean)
    assert float(lssg_row[3]) == pytest.approx(mean, rel=5e-3)  # three digits


def decimals(cell):
    return [len(digits) for digits in re.findall(r"\d+\.?(\d*)", cell)]


@settings(deadline=None, max_examples=16)
@given(factors=st.lists(st.sampled_from([1e-4, 0.02, 1.0, 700.0]), min_size=2, max_size=2))
def test_numbers_of_a_column_have_equal_decimals_and_three_digits_in_every_scene(factors):
    original, scenes = of_seven_trials(), {}
    for number, factor in enumerate(factors):
        result = original.scenes["a"]
        methods = {}
        for name, method in result.methods.items():
            solution, metrics = method.solution, method.metrics
            history = factor * solution.history
            solution = replace(solution, score=factor * solution.score, history=history)
            metrics = replace(metrics, mean=factor * metrics.mean, area=factor * metrics.area)
            methods[name] = replace(method, solution=solution, metrics=metrics)
        scenes[f"scene_{number}"] = replace(result, methods=methods, bound=factor * result.bound)
    results = replace(original, scenes=scenes)
    for rows, columns in ((summary_rows(results), (3, 4, 5, 6)), (gap_rows(results), (2, 3))):
        for column in columns:
            assert len({count for row in rows[1:] for count in decimals(row[column])}) == 1
    for row, factor in zip(summary_rows(results)[1::3], factors, strict=True):
        mean = float(original.scenes["a"].methods["lssg"].metrics.mean)
        assert float(row[3]) == pytest.approx(factor * mean, rel=5e-2)  # two digits of the lowest


def with_bound(results, bound):
    scenes = {name: replace(result, bound=bound) for name, result in results.scenes.items()}
    return replace(results, scenes=scenes)


def test_every_method_has_a_gap_to_the_bound():
    results = studied({"a": scene()}, trials=7)
    bound = focus_bound(results.scenes["a"].transfer_matrix)
    head = gap_rows(results)[1]
    assert head[:2] == ["a", "*bound*"]
    assert float(head[2].removesuffix(" Pa")) == pytest.approx(bound, rel=5e-3)
    median = float(results.scenes["a"].methods["gabs"].solution.score.median())  # of seven, one of them
    _, bound_row, lssg_row, _, gabs_row = gap_rows(with_bound(results, 2 * median))
    assert float(bound_row[2].removesuffix(" Pa")) == pytest.approx(2 * median, rel=5e-3)
    assert gabs_row[3].startswith("50.0")
    assert gabs_row[4:6] == [str(1 + 3 * 4), "- (0 of 7)"]
    assert lssg_row[5] == "-"


def test_a_report_of_target_pressures_has_differences_to_the_bound_and_no_verdict(tmp_path):
    results, report = reported(BOTH, tmp_path, trials=3, goal=TargetPressures([9, 6, 9]))
    _, _, lssg_row, *_ = gap_rows(results)
    result = results.scenes["homogeneous"]
    score = float(result.methods["lssg"].solution.score)
    assert float(lssg_row[2]) == pytest.approx(score, rel=0.01)
    assert float(lssg_row[3]) == pytest.approx(result.bound - score, rel=0.01)
    assert lssg_row[5] == "-"
    assert "target pressures" in report
    assert "%" not in "".join(lssg_row)
    assert "reproduced" not in report
    assert not re.search(r"\bnan\b|\binf\b|None", report)


def test_a_goal_without_bound_has_no_gap(tmp_path):
    results = with_bound(studied({"a": scene()}, trials=2), math.inf)
    write_report(results, {"a": scene()}, tmp_path, "autdtorch")
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert not re.search(r"\bnan\b|\binf\b|None", report)
    assert {row[3] for row in gap_rows(results)[1:]} == {"-"}


def test_scenes_of_different_goals_have_figures_of_their_own(tmp_path):
    results = studied({"a": scene()})
    other = studied({"b": scene()}, goal=TargetPressures([9, 6, 9]))
    both = replace(results, scenes=results.scenes | other.scenes)
    write_report(both, {"a": scene(), "b": scene()}, tmp_path, "autdtorch")
    shown = figures((tmp_path / "report.md").read_text(encoding="utf-8"))
    assert {"fig3d.png", "fig3d_2.png", "fig4.png", "fig4_2.png"} <= set(shown)


def test_a_median_of_evaluations_is_given_if_more_than_half_of_the_trials_got_there():
    results = studied({"a": scene()}, trials=7)
    method = results.scenes["a"].methods["gabs"]
    for reaching, text in ((7, "3"), (5, "3 (5 of 7)"), (3, "- (3 of 7)")):
        history = torch.ones(7, 5, dtype=torch.float64)
        history[:reaching, 2:] = 9.0
        solution = replace(method.solution, history=history, evaluations=torch.full((7,), 5))
        results.scenes["a"].methods["gabs"] = replace(method, solution=solution)
        assert gap_rows(with_bound(results, 10.0))[-1][5] == text


def test_the_gradient_is_a_baseline(tmp_path, monkeypatch):
    results = studied({"a": scene()}, trials=2)
    methods = results.scenes["a"].methods
    methods["gradient_ascent"] = methods.pop("lssg")
    score = float(methods["gradient_ascent"].solution.score)
    drawn = Mock(wraps=autdtorch.study.report.study_report.plot_convergence)
    monkeypatch.setattr(autdtorch.study.report.study_report, "plot_convergence", drawn)
    write_report(with_bound(results, 2 * score), {"a": scene()}, tmp_path, "autdtorch")
    row = gap_rows(with_bound(results, 2 * score))[-1]
    assert (row[1], row[3], row[4], row[5]) == ("gradient ascent", "50.0 %", "-", "-")
    history, levels = drawn.call_args.args
    assert list(history["a"]) == ["bayes_opt", "gabs"]
    near = pytest.approx(1.8 * score)
    assert levels["a"] == {"bound": 2 * score, "90 % of the bound": near, "gradient ascent": score}


def test_a_scene_without_observation_plane_is_left_out_of_the_pictures_that_need_one(tmp_path):
    _, report = reported({"plain": scene(plane=None)}, tmp_path)
    assert figures(report) == ["fig1_plain.png", "fig3abc.png", "fig3d.png", "fig4.png"]
    assert not re.search(r"\bnan\b|\binf\b|None", report)


def test_the_page_holds_the_same_and_needs_no_other_file(tmp_path):
    _, report = reported({"my_lab": scene()}, tmp_path, config="trials: 1\n")
    page = (tmp_path / HTML_FILE).read_text(encoding="utf-8")
    sources = re.findall(r'src="([^"]*)"', page)
    assert len(sources) == len(figures(report)) == 5
    for source, name in zip(sources, figures(report), strict=True):
        content = base64.b64decode(source.removeprefix("data:image/png;base64,"))
        assert content == (tmp_path / unquote(name)).read_bytes()
    assert not re.search(r"href=\"(?!#)|url\(|<script|@import", page)
    shown = [table for table in tables(report) if "![" not in str(table)]
    assert page.count("<table") == len(shown) == len(tables(report)) - 1
    for row in (cells for table in shown for cells in table if cells[0] != "---"):
        for cell in row:
            assert re.sub(r"[*_]", "", cell) in re.sub(r"[*_]|</?(em|strong)>", "", page)
    assert "trials: 1" in page


def test_methods_may_differ_between_scenes_and_claims_without_data_are_no_table(tmp_path):
    scenes = {"lab": scene(obstacles=(CUBE,)), "other": scene(None), "third": scene()}
    results = studied(scenes, trials=2)
    lab, other, _ = (result.methods for result in results.scenes.values())
    lab["my_method,levels=4"] = lab.pop("gabs")
    lab["gradient_ascent"] = lab.pop("lssg")
    for name in ("lssg", "gabs"):
        other.pop(name)
    text = write_report(results, scenes, tmp_path, "").with_suffix(".md").read_text("utf-8")
    assert "claims 2, 3, 4, 7 of 11" in text  # those of obstacles
    del results.scenes["third"]
    report = (
        write_report(results, scenes, tmp_path, "autdtorch collect it").with_suffix(".md").read_text("utf-8")
    )
    assert "paper" not in report.lower()
    assert not re.search(r"\bnan\b|\binf\b|None", report)


def test_matrices_that_were_kept_are_no_runs_and_not_exact(tmp_path):
    solver = {"method": "full", "spacing": 2.8e-3, "tolerance": 0.05, "cache": tmp_path / "kept"}
    for runs in ("3", "0, kept on disk"):  # one for each focus
        scenes = {"cube": scene(None, (CUBE,))}
        results = run_study(scenes, {"gabs": METHODS["gabs"]}, tmp_path / runs, solver=solver)
        assert simulation_rows(results)[1][4] == runs


def with_score(method, score):
    solution = method.solution
    return replace(method, solution=replace(solution, score=torch.full_like(solution.score, score)))


def scored(results, scores, bound=10.0):
    scenes = {}
    for name, result in results.scenes.items():
        methods = {
            method: with_score(result.methods[method], score) for method, score in scores[name].items()
        }
        scenes[name] = replace(result, methods=methods, bound=bound)
    return replace(results, scenes=scenes)


def test_the_findings_name_the_best_method_its_share_of_the_bound_and_what_obstacles_cost():
    results = studied(BOTH, trials=2)
    scores = {
        "homogeneous": {"lssg": 5.0, "bayes_opt": 8.0, "gabs": 6.0},
        "three_cubes": {"lssg": 2.0, "bayes_opt": 7.0, "gabs": 6.0},
    }
    winners, nearness, cost, claims = findings(scored(results, scores), judge_claims(results))
    assert all(text in winners for text in ("8.00 Pa in homogeneous", "7.00 Pa in three_cubes", "by BO"))
    assert "70.0 to 80.0\N{NO-BREAK SPACE}%" in nearness
    assert "12\N{NO-BREAK SPACE}% lower in three_cubes" in cost  # 12.5 %, rounded to even
    assert "LSSG loses most, 60\N{NO-BREAK SPACE}%" in cost
    assert "11 claims" in claims
    scores["three_cubes"] |= {"gabs": 6.99}
    assert "by BO and GABS" in findings(scored(results, scores), [])[0]
    assert "rank" not in winners
    assert "do not rank" in findings(scored(studied(BOTH, trials=1), scores), [])[0]


def test_findings_of_one_method_are_no_comparison_and_of_many_scenes_count_them():
    results = scored(studied({"a": scene(obstacles=(CUBE,))}), {"a": {"gabs": 4.0}})
    winners, nearness, cost = findings(results, judge_claims(results))
    assert "4.00 Pa in a" in winners
    assert "best" not in winners
    assert "40.0\N{NO-BREAK SPACE}%" in nearness
    assert "not known" in cost
    results = studied({"a": scene()})
    scenes = {f"scene_{number}": results.scenes["a"] for number in range(20)}
    scores = {name: {"gabs": 4.0} for name in scenes}
    sentences = findings(scored(replace(results, scenes=scenes), scores), [])
    assert "20 of 20 scenes" in sentences[0]
    assert max(map(len, sentences)) < 200  # characters


@pytest.mark.parametrize(("bound", "text"), [(math.inf, "No upper bound"), (-1.0, "3 Pa below")])
def test_findings_without_shares_of_the_bound(bound, text):
    results = scored(studied({"a": scene()}), {"a": {"gabs": -4.0}}, bound)
    assert text in findings(results, [])[1]


def test_what_is_missing_is_named(tmp_path):
    scenes = {"lab": scene(), "other": scene()}
    results = studied(scenes)
    results.scenes["other"].methods.pop("lssg")
    command = "autdtorch collect multirun"
    write_report(results, scenes, tmp_path, command, (), ["multirun/a=`1`", "multirun/b: lab"])
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "LSSG in other" in report
    assert code("multirun/a=`1`") in report
    assert "`multirun/b: lab`" in report


def test_a_single_trial_has_no_figures_of_one_point(tmp_path, monkeypatch):
    for name in ("lssg", "bayes_opt"):
        monkeypatch.delitem(METHODS, name)
    _, report = reported({"plain": scene()}, tmp_path)
    assert figures(report) == ["fig1_plain.png", "fig2.png", "fig3d.png"]


def test_of_many_methods_one_of_equal_scores_is_shown(tmp_path):
    results = studied({"a": scene()}, trials=2)
    methods = results.scenes["a"].methods
    for name, twin in (("bo_foci", "bayes_opt"), ("identify", "bayes_opt"), ("random_search", "gabs")):
        methods[name] = methods[twin]
    drawn = Mock(wraps=autdtorch.study.report.study_report.plot_planes)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(autdtorch.study.report.study_report, "plot_planes", drawn)
        write_report(results, {"a": scene()}, tmp_path, "autdtorch")
    scores = {name: float(method.solution.score.median()) for name, method in methods.items()}
    shown, folded = (list(call.args[0]["a"]) for call in drawn.call_args_list)
    assert sorted([*shown, *folded]) == sorted(methods)
    for name in folded:  # a method of its score is shown
        assert any(scores[name] == pytest.approx(scores[other], rel=0.01) for other in shown)
    for name in shown:  # and no other one
        assert sum(scores[name] == pytest.approx(scores[other], rel=0.009) for other in shown) == 1
    page = (tmp_path / HTML_FILE).read_text(encoding="utf-8")
    assert page.index("fold") < page.index("maps of the other methods</summary>")


def test_a_fold_of_a_name_is_text(tmp_path):
    fold = "<details><summary>mine</summary>"
    page = as_page(f"# Title\n\n{fold}\n\ntext\n", tmp_path)
    assert "<details" not in page
