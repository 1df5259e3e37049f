"""The worked example, short: a coarse grid, one drive, a few steps."""

import torch
from studies.recover_obstacle import TRUE_CENTER, drives, measured, recover


def test_a_few_steps_lead_towards_the_obstacle():
    drive = drives(1)
    first, *_, last = recover(drive, measured(drive, 1.4e-3), 2e-3, steps=3)
    assert last.misfit < first.misfit
    before, after = ((guess.center - torch.tensor(TRUE_CENTER)).norm() for guess in (first, last))
    assert after < before
