"""Stability: the first scenes of `scripts/check.py stability`, in short runs on its smallest grids."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest
from checks.stability import LONGER, run_trial
from shared.random_scenes import Trial, draw_trial

TRIALS = [replace(draw_trial(0, number, long_share=1.0), steps=1_000) for number in range(14)]


@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: str(trial.number))
def test_random_scenes_are_stable(
    trial: Trial, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.ERROR)
    monkeypatch.setattr("checks.stability.SAMPLES", 4)  # of windows of 31 steps; calls for two steps are slow
    outcome = run_trial(trial)
    if outcome.failed and outcome.finite:  # a resonance may still swing in a short run
        outcome = run_trial(replace(trial, steps=LONGER * trial.steps))
    assert not outcome.failed, str(outcome)
