"""The page of a report in a real browser: accessible, and readable in narrow and in dark windows."""

import functools
import re
from dataclasses import replace
from pathlib import Path

import pytest
from small_scenes import AIR, CUBE, small_scene

from autdtorch.methods.functions import gabs, lssg
from autdtorch.scene.geometry import Plane
from autdtorch.scene.scene import Scene
from autdtorch.study.report.study_report import write_report
from autdtorch.study.results import StudyResult
from autdtorch.study.run_study import run_study

METHODS = {
    "lssg": functools.partial(lssg, levels=4),
    "bayes_opt": functools.partial(gabs, levels=3),
    "gabs": functools.partial(gabs, levels=4),
}
WIDTHS = (1200, 500, 400, 360)  # px
SCHEMES = ("light", "dark")

CUT_OFF = """() => [...document.querySelectorAll("main *, nav *")].filter(one => {
  const scrolls = one.closest(".table");
  const box = one.getBoundingClientRect();
  const outside = !scrolls && (box.right > innerWidth + 0.5 || box.left < -0.5);
  const hidden = one.scrollWidth > one.clientWidth + 1 && one.clientWidth > 0
    && getComputedStyle(one).overflowX !== "auto" && getComputedStyle(one).overflowX !== "visible";
  return outside || hidden;
}).map(one => one.outerHTML.slice(0, 80))"""
"""Elements that reach out of the window, or that hide a part of their content."""

CONTRASTS = """() => {
  const channels = colour => colour.match(/[\\d.]+/g).slice(0, 3).map(Number);
  const style = getComputedStyle(document.body);
  return [style.color, style.backgroundColor].map(channels);
}"""


def scenes_of(*obstacles):
    plain, plane = small_scene(), Plane((20e-3, 12e-3, 12e-3), (1, 0, 0), (20e-3, 20e-3))
    parts = plain.array, AIR, 40e3, plain.control_points
    return {
        f"lab_{count}": Scene(*parts, (CUBE,) * count, plane, plain.domain) for count in range(*obstacles)
    }


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Pages of a study of several scenes and methods, with a gap, and of a single trial."""
    pages = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("autdtorch.study.report.study_report.rendering_problem", lambda: "not tried")
        for name, scenes, methods in (("many", scenes_of(3), METHODS), ("single", scenes_of(1, 2), ["gabs"])):
            folder = tmp_path_factory.mktemp(name)
            chosen = {method: METHODS[method] for method in methods}
            settings = {"trials": 3 if name == "many" else 1, "plane_spacing": 2e-3}
            results = run_study(scenes, chosen, folder, solver={"method": "free_space"}, **settings)
            if name == "many":
                results.scenes["lab_2"].methods.pop("lssg")
                config = "key: " + "a_long_value_without_any_space_" * 9
                results = replace(results, provenance=replace(results.provenance, config=config))
            command = "autdtorch collect multirun/" + "method=gabs,scene=two_cubes," * 6
            unfinished = ["multirun/method=gabs,scene=" + "two_cubes" * 12]
            pages[name] = write_report(results, scenes, folder, command, (), unfinished)
            if name == "many":
                pages["paper"] = write_report(as_large_as_the_papers(results), scenes, folder / "paper", "")
    return pages


def as_large_as_the_papers(results: StudyResult) -> StudyResult:
    """Results of six methods in each scene."""
    others = ("lssg", "bo_foci", "identify", "gradient_ascent")
    scenes = {
        name: replace(scene, methods=dict.fromkeys(others, scene.methods["gabs"]) | scene.methods)
        for name, scene in results.scenes.items()
    }
    return replace(results, scenes=scenes)


@pytest.fixture(scope="module", params=["many", "single"])
def page(browser, reports, request):
    opened = browser.new_page()
    opened.goto(reports[request.param].as_uri())
    yield opened
    opened.close()


def test_the_page_has_no_accessibility_violations(page):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="needs axe-core").Axe()
    for width, scheme in zip((1200, 400), SCHEMES, strict=True):
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)
        violations = axe.run(page).response["violations"]
        assert [(one["id"], one["nodes"][0]["html"][:80]) for one in violations] == []


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_cut_off_in_a_narrow_window(page, width):
    page.set_viewport_size({"width": width, "height": 900})
    overflow = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
    assert page.evaluate(overflow) == 0
    assert page.evaluate(CUT_OFF) == []
    for table in page.query_selector_all(".table"):
        table.evaluate("one => one.scrollLeft = 1e6")
        seen = (
            "one => one.getBoundingClientRect().right - one.querySelector('tr').getBoundingClientRect().right"
        )
        assert table.evaluate(seen) >= -0.5  # px; its last column can be scrolled into view


def test_the_page_begins_with_its_findings(page):
    headings = page.query_selector_all("h1, h2, h3, h4, h5, h6")
    levels = [int(one.evaluate("one => one.tagName[1]")) for one in headings]
    assert levels == [1, *[2] * (len(headings) - 1)]
    assert headings[1].inner_text() == "Findings"
    places = "() => ['#section-1 + ul', 'table', 'img'].map(one => document.querySelector(one).offsetTop)"
    findings, table, figure = page.evaluate(places)
    assert findings < table < figure
    assert len(page.query_selector_all("#section-1 + ul > li")) >= 3


def test_figures_have_texts_with_numbers_and_tables_have_headers(page):
    texts = page.eval_on_selector_all("img", "all => all.map(one => one.alt)")
    assert len(set(texts)) == len(texts) > 2
    assert all(re.search(r"\d", text) and len(text) > 40 for text in texts)
    assert page.eval_on_selector_all("th:not([scope])", "all => all.length") == 0
    assert page.eval_on_selector_all("table:not(:has(th[scope=row]))", "all => all.length") == 0


def test_a_report_of_the_papers_size_is_not_long(browser, reports):
    page = browser.new_page(viewport={"width": 1200, "height": 900})
    page.goto(reports["paper"].as_uri())
    assert page.evaluate("document.documentElement.scrollHeight") < 6000  # px
    page.eval_on_selector_all("details", "all => all.forEach(one => { one.open = true; })")
    assert page.evaluate("document.documentElement.scrollHeight") > 7000  # what is folded is there
    page.close()


def test_links_lead_to_the_sections(page):
    targets = "all => all.map(one => document.querySelector(one.getAttribute('href'))?.textContent)"
    assert page.eval_on_selector_all("nav a", targets) == page.eval_on_selector_all(
        "h2", "all => all.map(one => one.textContent)"
    )


def test_the_page_follows_the_colour_scheme(page):
    brightness = {}
    for scheme in SCHEMES:
        page.emulate_media(color_scheme=scheme)
        text, ground = page.evaluate(CONTRASTS)
        brightness[scheme] = sum(ground)
        assert abs(sum(text) - sum(ground)) > 450  # of 765
        figure = page.eval_on_selector("img", "one => getComputedStyle(one).backgroundColor")
        assert figure == "rgb(255, 255, 255)"  # as the figures have dark labels
    assert brightness["light"] > 600 > 150 > brightness["dark"]
