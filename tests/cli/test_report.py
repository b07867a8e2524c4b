"""The commands that make data and show results."""

import json

import pytest

from evaluations import WRONG, evaluation, places
from pointsplat_ns.cli import main
from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.pointsplat.report import report


def test_report_shows_every_scene_and_variant(tmp_path, capsys):
    path = tmp_path / "eval.json"
    path.write_text(json.dumps(evaluation()))
    main(["report", str(path)])
    shown = capsys.readouterr().out
    rows = [line.replace("│", " ").split() for line in shown.splitlines() if "dense" in line]
    assert [row[:2] for row in rows[:2]] == [["a", "yes"], ["b", "never"]]
    assert "compared with held-out photos" in " ".join(shown.split())  # a title may be wrapped
    assert shown.count("refined") == 5 and "25.00" in shown and "1,000" in shown and "0.250" in shown


def test_report_shows_a_dash_where_lpips_is_unknown(tmp_path, capsys):
    path = tmp_path / "eval.json"
    path.write_text(json.dumps(evaluation(lpips=None)))
    main(["report", str(path)])
    assert " - " in capsys.readouterr().out


def test_report_keeps_what_was_compared_with_photos_apart_from_what_was_compared_with_dense_renders(tmp_path, capsys):
    content = evaluation()
    results = content["results"]
    first = results["scenes"]["a"]
    only_dense = {row: {**first[row], "psnr": 44.0} for row in ("pruned", "refined")}
    only_dense["dense"] = {**first["dense"], "psnr": None}
    results["reference"] = "photos"
    for scene in results["scenes"].values():
        scene["reference"] = "photos"
    for name in ("c", "d"):
        results["scenes"][name] = {"seen_in_training": False, "reference": "dense renders", **only_dense}
    results["against_dense_renders"] = {"reference": "dense renders", "average": only_dense}
    path = tmp_path / "eval.json"
    path.write_text(json.dumps(content))
    main(["report", str(path)])
    photos, dense = capsys.readouterr().out.split("compared with the dense scenes' own")
    assert "held-out photos" in photos and "44.00" not in photos and photos.count("average") == 3
    assert "25.00" not in dense and dense.count("44.00") == 6 and dense.count("average") == 1
    names = {line.replace("│", " ").split()[0] for line in dense.splitlines() if " dense " in line}
    assert names == {"c", "d", "average"}


@pytest.mark.parametrize("content", [None, "", "[]", "{}", '{"results": {"psnr": 3.0}}', '{"results": {"scenes": {}}}'])
def test_report_of_something_else_is_one_line_and_status_1(tmp_path, capsys, content):
    path = tmp_path / "eval.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(SystemExit) as end:
        main(["report", str(path)])
    error = capsys.readouterr().err
    assert end.value.code == 1 and str(path) in error and error.count("\n") == 1


def test_results_that_are_malformed_anywhere_are_shown_or_one_error(tmp_path, capsys):
    path, refused, shown = tmp_path / "eval.json", 0, 0
    whole = evaluation()
    whole["results"]["against_dense_renders"] = {"reference": "dense renders", "average": whole["results"]["average"]}
    for place in places(whole):
        for wrong in WRONG:
            broken = json.loads(json.dumps(whole))
            node = broken
            for key in place[:-1]:
                node = node[key]
            node[place[-1]] = wrong
            path.write_text(json.dumps(broken))
            try:
                report(path)
                shown += 1
            except DataError:
                refused += 1
    assert refused > 300 and shown > 0


def test_names_of_scenes_are_shown_as_they_are(tmp_path, capsys):
    content = evaluation()
    content["results"]["scenes"]["[/b]"] = content["results"]["scenes"].pop("b")
    path = tmp_path / "eval.json"
    path.write_text(json.dumps(content))
    main(["report", str(path)])
    assert "[/b]" in capsys.readouterr().out


def test_rooms_are_named_by_their_seeds(tmp_path, coarse_rooms):
    main(["rooms", "-o", str(tmp_path / "r"), "--seeds", "3", "--frames", "2", "--width", "32", "--height", "24"])
    assert sorted(p.name for p in (tmp_path / "r").iterdir()) == ["room3"]
    assert len(list((tmp_path / "r" / "room3" / "results").glob("frame*"))) == 2
