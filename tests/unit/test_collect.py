"""Studies of a sweep, merged: which become one, and the names of the others."""

from functools import partial

import pytest
import yaml
from small_scenes import SECTION as SCENE

from autdtorch.io.scene_file import load_scene
from autdtorch.methods.functions import gabs, lssg
from autdtorch.study.report.tables import save_summary
from autdtorch.study.results_file import RESULTS_FILE
from autdtorch.study.run_study import run_study
from autdtorch.study.sweeps import collect_results

GRID = SCENE["array"]
METHODS = {"gabs": partial(gabs, levels=2), "lssg": lssg}


@pytest.fixture
def study(tmp_path):
    """Save a study in its own folder, like a job of a sweep."""

    def leave(scene=SCENE, method="gabs", files=(), **options):
        settings = {"scene": scene, "method": {"_target_": f"autdtorch.{method}"}, "files": {"air": [*files]}}
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
