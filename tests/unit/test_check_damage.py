"""Some of the damages of `scripts/check_damage.py`, which does hundreds."""

from pathlib import Path

import pytest
from check_damage import check, journal_problems

from autdtorch.utils.json_lines import SET_ASIDE, JsonLines, line_of


def test_damaged_files_change_no_number_and_cost_no_undamaged_line(tmp_path: Path) -> None:
    counts, wrong = check(damages=15, seed=1, folder=tmp_path)
    assert counts.total() == 15
    assert wrong == []


ROWS = [line_of({"evaluation": 0, "drive": [1.0], "seconds_on": 1.0}), line_of({"seconds_on": 2.0})]
WHOLE = b"\n".join([*ROWS, b""])


@pytest.mark.parametrize(
    ("damaged", "after", "aside", "told"),
    [
        (WHOLE[:-1], ROWS[:1], b"", ["1 whole rows lost", "on for 1.0 s"]),
        (WHOLE[:-1] + b"\x0b", ROWS[:1], ROWS[1] + b"\x0b\n", ["1 whole rows lost", "on for 1.0 s"]),
        (ROWS[0] + b"\x0b" + ROWS[1] + b"\n", [], b"", ["2 whole", "2 rows lost", "on for 0.0", "not kept"]),
        (WHOLE[:-2], ROWS[:1], b"", ["what was damaged is not kept"]),
    ],
)
def test_the_check_sees_rows_and_broken_ends_that_were_dropped(
    tmp_path: Path, damaged: bytes, after: list[bytes], aside: bytes, told: list[str]
) -> None:
    journal = tmp_path / "trial.jsonl"
    journal.write_bytes(b"".join(row + b"\n" for row in after))
    journal.with_name(journal.name + SET_ASIDE).write_bytes(aside)
    found = journal_problems(WHOLE, damaged, journal, 1)
    assert len(found) == len(told)
    assert all(part in one for part, one in zip(told, found, strict=True))
    journal.with_name(journal.name + SET_ASIDE).unlink()
    journal.write_bytes(damaged)
    JsonLines(journal, "", lambda row: None).mend()
    assert journal_problems(WHOLE, damaged, journal, 1) == []
