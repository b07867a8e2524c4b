"""Runs in the tables: their photos, and what they differ in from the paper."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import pointsplat_ns as ps
from lab.common.compare import dataset_photos
from lab.tables import layout, scenes
from lab.tables.measure import measure_tables
from lab.tables.scenes import differences, paper_dataset


def test_a_run_is_judged_by_its_held_out_photos_and_tuned_on_the_others(
    trained_walls, tmp_path, no_lpips, monkeypatch
):
    monkeypatch.setattr(
        layout, "plot_figure", lambda cells, groups, path: path.write_text("a figure")
    )
    (config,) = (trained_walls / "wall-b").rglob("config.yml")
    only = ("wall-b/dense/*", "wall-b/lightgaussian/50%", "wall-b/lightgaussian-tuned/50%")
    found = measure_tables((config.parent,), tmp_path / "tables", only=only, fine_tune=8)
    about = found.scenes["wall-b"]
    points = {cell["way"]: cell["point"] for cell in found.cells.values()}
    views, photos = dataset_photos(config.parent, "test", 10)
    dense = ps.load(config.parent)
    errors = torch.stack(
        [ps.psnr(ps.render(dense, view), photo) for view, photo in zip(views, photos, strict=True)]
    )
    psnr = {way: point["against_photos"]["psnr"] for way, point in points.items()}
    assert psnr["dense"] == pytest.approx(float(errors.mean()), abs=1e-4)
    assert psnr["lightgaussian-tuned"] > psnr["lightgaussian"]
    assert (
        points["lightgaussian-tuned"]["against_dense"]["psnr"] < 100
        and about["origin"] == "held-out photos"
    )
    assert (
        about["dataset"] == ""
        and about["group"] == "scenes"
        and "Splatfacto steps" in about["differs"]
    )


def replica(
    folder: Path, name: str, size: tuple[int, int] = (1200, 680), frames: int = 2000
) -> SimpleNamespace:
    """A run of a scene in the Replica layout whose photos are empty files."""
    scene = folder / name
    (scene / "results").mkdir(parents=True)
    for number in range(frames):
        (scene / "results" / f"frame{number:06d}.jpg").touch()
    (scene / "traj.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * frames)
    camera = {
        "w": size[0],
        "h": size[1],
        "fx": 600.0,
        "fy": 600.0,
        "cx": 599.5,
        "cy": 339.5,
        "scale": 6553.5,
    }
    (scene / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return run(scene, "pointsplat_ns.nerfstudio_plugin.replica.dataparser.ReplicaDataParserConfig")


def run(data: Path, parser: str) -> SimpleNamespace:
    return SimpleNamespace(data=data, dataparser_class=parser)


def test_the_papers_replica_is_known_by_name_size_and_number_of_photos(tmp_path):
    assert paper_dataset(replica(tmp_path, "office2")) == "Replica"
    assert paper_dataset(replica(tmp_path, "kitchen", frames=3)) == ""
    assert paper_dataset(replica(tmp_path / "few", "office2", frames=3)) == ""
    # Drawn rooms are of the same layout and may be called the same.
    assert paper_dataset(replica(tmp_path / "made", "room0", (320, 240), frames=80)) == ""


@pytest.mark.parametrize(
    ("scene", "below", "parser", "dataset"),
    [
        ("0a5c013435", "", "scannetpp_dataparser.ScanNetppDataParserConfig", "ScanNet++"),
        ("0a5c013435", "dslr/colmap", "colmap_dataparser.ColmapDataParserConfig", "ScanNet++"),
        ("0a5c013435", "", "nerfstudio_dataparser.NerfstudioDataParserConfig", ""),
        ("fox", "", "scannetpp_dataparser.ScanNetppDataParserConfig", ""),
        ("fox", "dslr", "colmap_dataparser.ColmapDataParserConfig", ""),
    ],
)
def test_scannetpp_is_known_by_the_names_of_its_scenes(scene, below, parser, dataset, tmp_path):
    (tmp_path / scene / "dslr" / "colmap").mkdir(parents=True)
    assert (
        paper_dataset(run(tmp_path / scene / below, f"nerfstudio.data.dataparsers.{parser}"))
        == dataset
    )


@pytest.mark.parametrize(
    "change, differs",
    [
        ({}, ()),
        ({"seen": 2}, ("2 of 3 held-out photos",)),
        ({"side": 32}, ("photos reduced to 32 of 64 pixels in width",)),
        ({"downscale": 4}, ("photos reduced to 0.25 of their width",)),
        ({"sh_degree": 0}, ("SH degree 0",)),
        ({"masks": True}, ("masks are not applied",)),
        ({"seen": 1, "step": 0}, ("1 of 3 held-out photos", "1 of 15,000 Splatfacto steps")),
    ],
)
def test_differences_from_the_papers_protocol_are_named(monkeypatch, change, differs):
    case = {
        "seen": 3,
        "side": 64,
        "downscale": None,
        "sh_degree": 3,
        "step": 14_999,
        "masks": False,
    } | change
    fields = {
        "datamanager_fields": {},
        "dataparser_fields": {"downscale_factor": case["downscale"]},
    }
    known = SimpleNamespace(folder=Path("run"), data=None, step=case["step"], **fields)
    photo = SimpleNamespace(mask=torch.ones(1) if case["masks"] else None)
    monkeypatch.setattr(scenes, "run_photos", lambda *_: [photo] * 3)
    assert differences(known, case["sh_degree"], case["seen"], (case["side"], 64)) == differs
