"""The worked example, short: a coarse grid, one drive, a few steps."""

import torch
from studies.recover_obstacle import TRUE_CENTER, drives, measured, recover


def off(guess):
    return float((guess.center - torch.tensor(TRUE_CENTER)).norm())


def test_a_few_steps_lead_towards_the_obstacle():
    drive = drives(1)
    way = list(recover(drive, measured(drive, 1.4e-3), 2e-3, steps=3))
    assert way[-1].misfit < way[0].misfit
    assert off(way[-1]) < off(way[0])
