"""lab/judge/tables_record.py: the record of the paper's tables is what was measured."""

import json
from pathlib import Path

import pytest

from lab.judge import tables_record as record

RECORD = Path(__file__).parents[2] / "docs" / "record"


def test_page_is_what_the_program_writes_from_the_rows():
    assert record.page(record.read(RECORD / "results.json")) == (RECORD / "results.md").read_text("utf-8")


def test_a_changed_row_changes_the_page(tmp_path):
    content = json.loads((RECORD / "results.json").read_text("utf-8"))
    [cell] = [cell for cell in content["cells"] if cell["point"]["key"] == "room52/paper/10%"]
    cell["point"]["against_photos"]["psnr"] += 2.0
    (tmp_path / "changed.json").write_text(json.dumps(content))
    before, after = (record.page(record.read(path)) for path in (RECORD / "results.json", tmp_path / "changed.json"))
    assert "| 10 % | PointSplat\\* | 10.91 |" in before
    assert "| 10 % | PointSplat\\* | 11.91 |" in after  # of two scenes


def test_another_file_is_refused_by_name(tmp_path):
    path = tmp_path / "other.json"
    path.write_text("{}")
    with pytest.raises(SystemExit, match="other.json: cannot be read"):
        record.read(path)
