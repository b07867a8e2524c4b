"""A run that nerfstudio 1.1.5 itself trained with gsplat on a GPU, of a real capture."""

import shutil
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from making import SHARED_DATA
from pointsplat_ns.nerfstudio_plugin.dataset_views import run_photos
from pointsplat_ns.scene.image_files import in_unit_range
from pointsplat_ns.scene.runs import open_run

RUN = SHARED_DATA / "splatfacto" / "fox" / "splatfacto" / "2026-11-26_gsplat"
CAPTURE = SHARED_DATA / "scannetpp" / "fox"

pytestmark = [
    pytest.mark.usefixtures("quick"),
    pytest.mark.skipif(
        not RUN.is_dir() or not CAPTURE.is_dir(), reason="the genuine run is not at hand"
    ),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A copy beside its capture, where its config.yml expects it."""
    root = tmp_path_factory.mktemp("genuine")
    (root / "data").mkdir()
    (root / "data" / "fox").symlink_to(CAPTURE)
    return Path(shutil.copytree(RUN, root / "outputs" / "fox" / "splatfacto" / RUN.name))


def test_its_checkpoint_is_read_to_the_bit(run):
    scene = ps.load(run)
    state = torch.load(next((run / "nerfstudio_models").iterdir()), weights_only=True)["pipeline"]
    assert len(scene) == 20_144 and scene.sh_degree == 3
    for name in ("means", "scales", "quats", "opacities", "features_dc", "features_rest"):
        assert torch.equal(getattr(scene, name), state[f"_model.gauss_params.{name}"])
    known = open_run(run)
    assert (known.method_name, known.step) == ("splatfacto", 6000) and known.data.samefile(CAPTURE)


def test_its_renders_show_its_held_out_photos(run):
    photos = run_photos(run, "test")
    scene = ps.load(run)
    assert len(photos) == 5 and len(ps.dataset_views(run)) == 45
    grey = [ps.render(scene, photo.view).mean(dim=-1).flatten() for photo in photos]
    seen = [in_unit_range(photo.target).mean(dim=-1).flatten() for photo in photos]
    alike = torch.corrcoef(torch.stack([*grey, *seen]))[:5, 5:]
    # a ninth of a scene just behind a reset of its opacities is dark: its PSNR tells nothing, its
    # structure does
    assert torch.equal(alike.argmax(dim=0), torch.arange(5)), (
        alike
    )  # the render that is most like each photo
