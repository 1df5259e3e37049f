"""`autdtorch collect`: one table and one report of all studies in a folder."""

from __future__ import annotations

import logging
import shlex
from pathlib import Path

from autdtorch.cli.study_command import print_table

_HELP = """autdtorch collect FOLDER [modules=NAME]

Merges the finished studies in a folder and below it, such as those of a sweep in multirun, into one table
(summary.csv) and one report (report.md, report.html), which are written there. modules=NAME allows obstacles
of one's own, which the module NAME defines."""


def collect(arguments: list[str]) -> None:
    """Merge the studies of the folder that the arguments name."""
    from autdtorch.study.report.study_report import write_report
    from autdtorch.study.report.summary_table import SUMMARY_FILE, save_summary
    from autdtorch.study.sweeps import collect_results

    if {"-h", "--help"} & set(arguments):
        print(_HELP)
        return
    modules = [word.removeprefix("modules=") for word in arguments if word.startswith("modules=")]
    folders = [word for word in arguments if not word.startswith("modules=")]
    if len(folders) != 1 or folders[0].startswith("-"):
        raise ValueError(f"collect: {shlex.join(arguments)!r}; must be one folder, such as multirun")
    logging.basicConfig(format="%(message)s")
    folder = Path(folders[0])
    sweep = collect_results(folder, modules)
    save_summary(sweep.results, sweep.swept, folder / SUMMARY_FILE)
    command = shlex.join(["autdtorch", "collect", *arguments])
    report = write_report(sweep.results, sweep.scenes, folder, command, sweep.seeds)
    count = "1 study" if sweep.studies == 1 else f"{sweep.studies} studies"
    end = f"{count}: the table is {folder / SUMMARY_FILE}, the report {report}"
    print_table(sweep.results, end)
