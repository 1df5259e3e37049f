"""A study of two scenes and twelve slow trials, run as a program so that a test can kill it."""

import dataclasses
import sys
import time
from pathlib import Path

from small_scenes import CUBE, small_scene

import autdtorch.study.run_study
from autdtorch.methods.functions import gabs
from autdtorch.scene.geometry import Plane

PLANE = Plane(center=(20e-3, 12e-3, 12e-3), normal=(1, 0, 0), size=(20e-3, 16e-3))
SOLVER = {"method": "auto", "spacing": 2e-3, "tolerance": 0.1, "kernel": "reference"}


def slow_gabs(objective, trials=1, seed=0):
    time.sleep(0.15)
    return gabs(objective, levels=4, trials=trials, seed=seed)


def main():
    slow_gabs.__module__ = gabs.__module__  # results of others' methods are not used again
    autdtorch.study.run_study.BLOCK = 1
    scenes = {
        "empty": dataclasses.replace(small_scene(), observation_plane=PLANE),
        "cube": dataclasses.replace(small_scene((CUBE,)), observation_plane=PLANE),
    }
    print("ready", flush=True)
    solver = SOLVER | {"cache": Path(sys.argv[1]) / "matrices"}
    settings = {"trials": 6, "plane_spacing": 4e-3, "folder": Path(sys.argv[1]), "config": "a"}
    autdtorch.study.run_study.run_study(scenes, {"gabs": slow_gabs}, solver=solver, **settings)


if __name__ == "__main__":
    main()
