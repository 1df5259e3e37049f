"""Studies of a sweep, merged; results from others, whose names and texts are safe in files and reports."""

import functools
import re
import tempfile
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from small_scenes import SECTION as SCENE

from autdtorch.io.scene_file import load_scene
from autdtorch.methods.functions import gabs, lssg
from autdtorch.study.report.document import as_page, code, fenced, table
from autdtorch.study.report.study_report import write_report
from autdtorch.study.report.tables import SUMMARY_FILE, save_summary
from autdtorch.study.results_file import RESULTS_FILE, load_results, save_results
from autdtorch.study.run_study import run_study
from autdtorch.study.sweeps import collect_results

GRID = SCENE["array"]
METHODS = {"gabs": partial(gabs, levels=2), "lssg": lssg}


@pytest.fixture
def study(tmp_path):
    """Save a study in its own folder, like a job of a sweep."""

    def leave(scene=SCENE, method="gabs", files=(), note="plain", **options):
        settings = {"scene": scene, "method": {"_target_": f"autdtorch.{method}"}, "files": {"air": [*files]}}
        settings["note"] = note
        run_study(
            {"air": load_scene(scene)},
            {method: METHODS[method]},
            solver={"method": "free_space"},
            folder=tmp_path / str(len(list(tmp_path.iterdir()))),
            config=yaml.safe_dump(settings),
            **options,
        )

    return leave


def names(sweep):
    return list(sweep.results.scenes)


def only_method(folder):
    (method,) = collect_results(folder).results.scenes["air"].methods.values()
    return method


def test_seeds_of_a_random_method_are_trials_even_if_two_end_alike(study, tmp_path):
    for seed in range(8):
        study(seed=seed)
    method = only_method(tmp_path)
    assert method.trials == 8
    # Three transducers of two levels each: some of eight searches end at equal drives.
    assert len({tuple(drive.tolist()) for drive in method.solution.drive}) < 8


@pytest.mark.parametrize(
    ("studies", "trials"),
    [
        ([{"method": "lssg", "seed": 0}, {"method": "lssg", "seed": 1}], 1),  # no random choices
        ([{"trials": 3}, {"trials": 2}], 3),  # of a seed, the longest study
        ([{"scene": {**SCENE, "frequency": 40000}}, {}], 1),  # 40000 is 40e3
    ],
)
def test_trials_are_counted_once(study, tmp_path, studies, trials):
    for settings in studies:
        study(**settings)
    assert only_method(tmp_path).trials == trials


def test_a_swept_list_is_one_setting_in_the_order_of_its_values(study, tmp_path):
    for pitch in (10e-3, 9e-3):
        study({**SCENE, "array": {**GRID, "pitch": pitch, "shape": [2, 3] if pitch == 9e-3 else [2, 2]}})
    sweep = collect_results(tmp_path)
    assert names(sweep) == ["air,pitch=0.009,shape=2x3", "air,pitch=0.01,shape=2x2"]
    assert sweep.swept[names(sweep)[0], "gabs"] == {"scene.array.pitch": 0.009, "scene.array.shape": [2, 3]}


def test_common_settings_are_written_once(study, tmp_path):
    study()
    study({**SCENE, "frequency": 41e3, "name": "lab"}, note=None)
    study(method="lssg", note="yes: 1")
    text = collect_results(tmp_path).results.provenance.config
    first, second, third = text.split("\n\n")
    settings = yaml.safe_load(first)
    assert settings["scene"] == SCENE
    assert yaml.safe_load(second) == {"scene.frequency": 41e3, "scene.name": "lab", "note": None}
    assert yaml.safe_load(third) == {"method._target_": "autdtorch.lssg", "note": "yes: 1"}
    assert first.startswith(f"# {tmp_path / '0'}\n")
    assert second.startswith(f"# {tmp_path / '1'}, otherwise like {tmp_path / '0'}\n")


def test_names_that_would_be_equal_get_a_digest(study, tmp_path):
    # A file was changed between two jobs.
    study(files=("11",))
    study(files=("22",), seed=1)
    first, second = names(sweep := collect_results(tmp_path))
    assert first != second
    assert first.startswith("air-")
    save_summary(sweep, tmp_path / "summary.csv")
    assert "['11']" in (tmp_path / "summary.csv").read_text(encoding="utf-8")


def test_scenes_without_the_same_keys_have_names_that_files_can_have(study, tmp_path):
    box = {"type": "box", "size": [4e-3] * 3, "rigid": True}
    boxes = [{**box, "center": [0.02, 0.01 * place, 0]} for place in range(-2, 3)]
    for count in (0, 4, 5):
        study({**SCENE, "obstacles": boxes[:count]})
    found = names(collect_results(tmp_path))
    assert len(set(found)) == 3
    assert max(map(len, found)) < 130


def test_unfinished_scenes_are_left_out_with_a_warning(tmp_path, caplog):
    config = {"scenes": {"air": SCENE, "lab": SCENE}, "methods": {"lssg": {"_target_": "autdtorch.lssg"}}}
    run_study({"air": load_scene(SCENE)}, {"lssg": lssg}, folder=tmp_path, config=yaml.safe_dump(config))
    sweep = collect_results(tmp_path)
    assert names(sweep) == ["air"]
    assert caplog.messages[-1].endswith(": lab")
    assert sweep.unfinished == (f"{tmp_path}: lab",)


@pytest.mark.parametrize(
    "config",
    ["", "text", "[1, 2]", "{", "scene: 1", "scenes: [air]", "scenes: {air: {}}", "scene: {}\nfiles: 3"],
)
def test_a_study_without_the_settings_of_the_command_line_is_refused(tmp_path, config):
    run_study({"air": load_scene(SCENE)}, {"lssg": lssg}, folder=tmp_path, config=config)
    with pytest.raises(ValueError, match=r"results\.h5: "):
        collect_results(tmp_path)


def test_a_copy_of_a_study_is_counted_once_with_a_warning(study, tmp_path, caplog):
    for seed in (0, 1):
        study(seed=seed)
    (tmp_path / "0" / RESULTS_FILE).write_bytes((tmp_path / "1" / RESULTS_FILE).read_bytes())
    assert only_method(tmp_path).trials == 1
    (line,) = caplog.messages
    assert all(str(tmp_path / name) in line for name in "01")


HTML = "<img src=x onerror=alert(1)>\n\n<script>alert(1)</script>\n\na ` <b onclick=alert(1)>b</b>"
MARKDOWN = "![a](https://evil.example/a.png) [b](https://evil.example) <https://evil.example> `` ``` ~~~"
HOSTILE = f"{HTML}\n{MARKDOWN}\n\n</details>\n```\n{HTML}\n[x]: https://evil.example\n[x]"


@pytest.fixture(autouse=True)
def without_renderer(monkeypatch):
    monkeypatch.setattr("autdtorch.study.report.study_report.rendering_problem", lambda: "not tried")


def results_of(solver=None, seed=0):
    settings = {"scene": SCENE, "method": {"_target_": "autdtorch.gabs"}, "solver": solver or {}}
    methods = {"gabs": functools.partial(gabs, levels=2)}
    with tempfile.TemporaryDirectory() as folder:
        scenes, text = {"air": load_scene(SCENE)}, yaml.safe_dump(settings)
        return run_study(scenes, methods, Path(folder), seed=seed, config=text)


NAMES = ["", ".", "a/b", "a\0b", "..", "...", "..\\a", "a\nb", "a b", "x" * 101, "é" * 51, "<b>", "![a](b)"]


@pytest.mark.parametrize("name", NAMES)
def test_a_study_refuses_a_name_that_is_no_part_of_a_file_name(tmp_path, name):
    scene, method = load_scene(SCENE), functools.partial(gabs, levels=2)
    with pytest.raises(ValueError, match=r"^scenes: "):
        run_study({name: scene}, {"gabs": method}, tmp_path)
    with pytest.raises(ValueError, match=r"^methods: "):
        run_study({"air": scene}, {name: method}, tmp_path)


@pytest.mark.parametrize("name", ["..", "<b>"])
def test_results_with_such_a_name_are_refused(tmp_path, name):
    results = results_of()
    (scene,) = results.scenes.values()
    method_of_this_name = {"air": replace(scene, methods={name: scene.methods["gabs"]})}
    for field, scenes in (("scenes", {name: scene}), ("methods", method_of_this_name)):
        save_results(replace(results, scenes=scenes), tmp_path)
        with pytest.raises(ValueError, match=rf"results\.h5: {field}: "):
            load_results(tmp_path)


def with_origin(results, **changes):
    return replace(results, provenance=replace(results.provenance, **changes))


def left(folder, *studies):
    sweep = folder / "sweep"
    for number, results in enumerate(studies):
        save_results(results, sweep / str(number))
    return sweep


def collect(sweep):
    found = collect_results(sweep)
    save_summary(found, sweep / SUMMARY_FILE)
    page = write_report(found.results, found.scenes, sweep, "autdtorch collect", found.seeds)
    return page.read_text(encoding="utf-8")


def test_the_names_of_what_was_swept_stay_in_the_folder(tmp_path):
    solvers = ({"../../elsewhere": 1, "<b>": 1}, {"../../elsewhere": "../<b>", "語" * 300: "a\0b"})
    page = collect(left(tmp_path, *map(results_of, solvers)))
    assert [path.name for path in tmp_path.iterdir()] == ["sweep"]
    assert len(list((tmp_path / "sweep").glob("fig1_*.png"))) == len(solvers)
    assert "<b>" not in page


def test_settings_that_read_a_variable_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "hunter2")
    config = yaml.safe_dump({"scene": {**SCENE, "name": "${oc.env:SECRET}"}, "method": {}})
    with pytest.raises(ValueError, match=r"name: '\$\{oc\.env:SECRET\}'"):
        collect_results(left(tmp_path, with_origin(results_of(), config=config)))


@pytest.mark.parametrize("end", ["", ".partial"])
def test_a_report_is_not_written_through_a_link(tmp_path, end):
    sweep = left(tmp_path, results_of())
    mine = tmp_path / "mine"
    mine.write_text("mine", encoding="utf-8")
    for name in (SUMMARY_FILE, "report.md", "report.html", "fig1_air.png", "fig3d.png"):
        (sweep / f"{name}{end}").symlink_to(mine)
    collect(sweep)
    assert mine.read_text(encoding="utf-8") == "mine"
    assert not any((sweep / name).is_symlink() for name in (SUMMARY_FILE, "report.md", "report.html"))


class Tags(HTMLParser):
    """Tags and attributes of a page."""

    def __init__(self, page):
        super().__init__()
        self.found: list[tuple[str, str, str]] = []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.found += [(tag, "", ""), *((tag, name, value or "") for name, value in attributes)]


OURS = {
    "html", "head", "meta", "title", "style", "body", "h1", "h2", "p", "br", "em", "strong", "code",
    "main", "nav", "a", "figure", "figcaption", "pre", "img", "div", "table", "thead", "tbody", "tr",
    "th", "td", "ul", "li", "details", "summary",
}  # fmt: skip
ATTRIBUTES = {"lang", "charset", "name", "content", "class", "src", "alt", "href", "id", "scope", "role"}
ATTRIBUTES |= {"aria-label", "tabindex", "width"}


def test_a_report_shows_hostile_texts_as_texts(tmp_path):
    versions = {"autdtorch": HOSTILE, HOSTILE: "1"}
    texts = dict.fromkeys(("config", "source_digest", "date"), HOSTILE)
    hostile = with_origin(results_of(), versions=versions, **texts)
    page = write_report(hostile, {"air": load_scene(SCENE)}, tmp_path, HOSTILE).read_text("utf-8")
    found = Tags(page).found
    assert {tag for tag, _, _ in found} <= OURS
    assert {name for _, name, _ in found if name} <= ATTRIBUTES
    assert all(value.startswith("data:image/png;base64,") for _, name, value in found if name == "src")
    assert all(re.fullmatch(r"#section-\d+", value) for _, name, value in found if name == "href")
    # Each of the texts is there, and the version of autdtorch twice.
    assert page.count("alert(1)") == 7 * HOSTILE.count("alert(1)")
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    tokens = MarkdownIt("commonmark").enable("table").parse(text)  # as others show it: with links and HTML
    parts = [part for token in tokens for part in (token, *(token.children or ()))]
    assert not any(part.type == "link_open" for part in parts)
    assert not any("alert" in part.content for part in parts if part.type.startswith("html"))
    images = {str(part.attrGet("src")) for part in parts if part.type == "image"}
    assert images == {path.name for path in tmp_path.glob("*.png")}


@pytest.mark.parametrize("text", [HTML, MARKDOWN[1:], "&lt;b&gt; <!-- c --> <?d?> <![CDATA[e]]>"])
def test_a_page_has_no_html_and_no_links_but_its_own(tmp_path, text):
    assert {tag for tag, _, _ in Tags(as_page(f"# {text}\n\n{text}\n", tmp_path)).found} <= OURS


@pytest.mark.parametrize("source", ["../secret.png", "/etc/passwd", "https://a.example", "%2e%2e/secret.png"])
def test_a_page_takes_images_of_its_folder_alone(tmp_path, source):
    (tmp_path / "page").mkdir()
    (tmp_path / "secret.png").write_bytes(b"secret")
    with pytest.raises(ValueError, match=r"^image: "):
        as_page(f"# Title\n\n![a]({source})\n", tmp_path / "page")


@given(st.text() | st.text("`|\\<b>![a](c)\n\r "))
def test_code_is_code_whatever_the_text(text):
    parse = MarkdownIt("commonmark").enable("table").parse
    (block,) = parse(fenced(text))
    assert block.type == "fence"
    for shown, count in ((f"x {code(text)} y", 1), (table([["head", "value"], ["x", code(text)]]), 4)):
        cells = [token for token in parse(shown) if token.type == "inline"]
        assert len(cells) == count
        assert {part.type for part in cells[-1].children or ()} <= {"text", "code_inline"}
