"""Some of the damages of `scripts/check.py damage`, which does hundreds."""

from pathlib import Path

from checks.damage import check


def test_damaged_files_change_no_number_and_cost_no_undamaged_line(tmp_path: Path) -> None:
    counts, wrong = check(damages=15, seed=1, folder=tmp_path)
    assert counts.total() == 15
    assert wrong == []
