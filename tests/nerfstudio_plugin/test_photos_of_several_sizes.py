"""A run on photos of two devices, one of them turned: trained, pruned and compacted at the size of
each photo."""

import json
from pathlib import Path

import cv2
import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

import pointsplat_ns as ps
from captures import FRAMES, HEIGHT, WIDTH, Capture
from pointsplat_ns.cli import main
from pointsplat_ns.nerfstudio_plugin.dataset_views import run_photos
from pointsplat_ns.pipeline.repair_budget import PHOTO_STEPS
from pointsplat_ns.scene.image_files import in_unit_range

pytestmark = pytest.mark.usefixtures("quick")


def write_several_sizes(folder: Path) -> Path:
    """A capture with intrinsics in each frame; every third photo is one half across and down, every
    third one is cut to a portrait."""
    Capture().write_nerfstudio(folder)
    meta = json.loads((folder / "transforms.json").read_text())
    names = ("w", "h", "fl_x", "fl_y", "cx", "cy")
    for index, frame in enumerate(meta["frames"]):
        own = {name: meta[name] for name in names}
        path = folder / frame["file_path"]
        photo = cv2.imread(str(path))
        if index % 3 == 1:
            photo = cv2.resize(photo, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
            own = {name: value / 2 for name, value in own.items()}
            own |= {"w": WIDTH // 2, "h": HEIGHT // 2}
        elif index % 3 == 2:
            left = 14
            photo = photo[:, left : left + 36]
            own |= {"w": 36, "cx": own["cx"] - left}
        cv2.imwrite(str(path), photo)
        frame |= own
    for name in names:
        del meta[name]
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


@pytest.fixture(scope="module")
def run(wall_config, run_training, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sizes")
    config = wall_config(write_several_sizes(folder / "data"), folder / "outputs", 60)
    config.pipeline.datamanager.dataparser = NerfstudioDataParserConfig(load_3D_points=True)
    run_training(config)
    return config.get_base_dir()


SIZES = {(WIDTH, HEIGHT), (WIDTH // 2, HEIGHT // 2), (36, HEIGHT)}


def test_views_and_photos_of_a_run_have_the_size_of_each_photo(run):
    views = ps.dataset_views(run)
    photos = run_photos(run)
    held_out = run_photos(run, "test")
    assert len(views) == len(photos) and len(photos) + len(held_out) == FRAMES
    for view, photo in zip(views, photos, strict=True):
        assert (view.height, view.width, 3) == photo.target.shape
        assert torch.equal(view.viewmat, photo.view.viewmat) and torch.equal(view.K, photo.view.K)
    assert {size[:2] for size in views.image_sizes()} == SIZES


def test_a_scene_trained_on_them_shows_each_of_them(run):
    scene = ps.load(run)
    for example in run_photos(run):
        photo = example._replace(target=in_unit_range(example.target).float())
        flat = photo.target.mean((0, 1), keepdim=True).expand(photo.target.shape)
        assert photo.psnr(ps.render(scene, photo.view)) > photo.psnr(flat) + 1.0


def test_prune_takes_the_poses_of_the_run(run, tmp_path, capsys):
    main(["prune", str(run), "--keep", "50%", "-o", str(tmp_path / "a.ply"), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["origin"] == "poses of the dataset"
    sizes = {(found["width"], found["height"]), *map(tuple, found["other_sizes"])}
    assert sizes == SIZES


def test_compact_trains_on_the_photos_of_the_run(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(PHOTO_STEPS, "quick", 4)
    words = ["compact", str(run), "--photos", "--keep", "50%", "-o", str(tmp_path / "a.ply")]
    main([*words, "--json"])
    said = capsys.readouterr()
    assert json.loads(said.out)["photos"]["photos"] > 3
    assert "held-out photos:" in said.err


def test_tradeoff_judges_by_all_held_out_photos(run, tmp_path):
    found = ps.measure_tradeoff(run, tmp_path / "trade", keep=("50%",), repairs=("none",), views=8)
    assert found.notes == () or not any("size" in note for note in found.notes)
    dense = found.points[0]
    assert dense.against_photos is not None and dense.against_photos.psnr > 10
    page = (tmp_path / "trade" / "tradeoff.html").read_text()
    sizes = {(found.width, found.height), *(size[:2] for size in found.other_sizes)}
    assert sizes <= SIZES and f"Pictures and times are of {found.width} x {found.height}" in page
