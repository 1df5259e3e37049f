"""What is not of the kind that is asked for is named, with what is accepted."""

from collections.abc import Callable

import pytest
import torch

from autdtorch.hardware import (
    OPENMPD,
    EmulatedSensor,
    FileSensor,
    HardwareObjective,
    LimitedLink,
    Limits,
    check_transducers,
    open_link,
    open_scope,
    openmpd_boards,
)

SENSOR = FileSensor("never-read", points=2)


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda trial, link: LimitedLink(link.link, 1.0), r"limits: 1\.0; must be a Limits"),
        (lambda trial, link: LimitedLink(link, Limits(1.0)), "link: .*LimitedLink.*; must be a Link$"),
        (lambda trial, link: check_transducers(link.link, None, 2), "link: .*; must be a LimitedLink"),
        (lambda trial, link: open_link("sonicsurface"), "device: 'sonicsurface'; must be a Device"),
        (lambda trial, link: openmpd_boards(["left.pat"]), r"boards\[0\]: 'left.pat'; must be an OpenMPDB"),
        (lambda trial, link: open_scope("2a8d:1770"), "chip: '2a8d:1770'; must be 2 integers"),
        (lambda trial, link: HardwareObjective("x.yaml", link, SENSOR, "log"), "scene: 'x.yaml'; must be a"),
        (lambda trial, link: HardwareObjective(trial.scene, link, 1, trial.log), "sensor: 1; must be a S"),
        *(
            (
                lambda trial, link, bad=bad: HardwareObjective(trial.scene, link, SENSOR, trial.log, bad),
                "settings: .*; must be a mapping of what JSON can hold",
            )
            for bad in ({1}, {"gain": torch.ones(1)})
        ),
    ],
)
def test_another_kind_of_thing_is_refused_by_name(trial, use: Callable[..., object], message: str):
    with trial.link(trial.bench()) as link:
        limited = LimitedLink(link, Limits(1.0))
        with pytest.raises(ValueError, match=message):
            use(trial, limited)
    assert not trial.log.exists()


@pytest.mark.parametrize(
    ("drive", "message"),
    [
        (torch.ones(2, 16).cdouble(), r"drive: shape \(2, 16\); must be \(16,\), a single drive"),
        (1.5 * torch.ones(16).cdouble(), r"drive: amplitude 1\.5; every \|q\| must be in"),
    ],
)
def test_a_drive_that_is_none_is_not_scaled_into_one_and_starts_no_clock(trial, drive, message: str):
    bench = trial.bench(OPENMPD)
    with trial.link(bench, OPENMPD) as link:
        limited = LimitedLink(link, Limits(0.5))
        with pytest.raises(ValueError, match=message):
            limited.play(drive)
        assert limited.seconds_on == 0
        assert limited._timer is None
    assert EmulatedSensor(bench).read().max() == 0
