"""``ns-eval`` and ``ns-export gaussian-splat``."""

from __future__ import annotations

import json

import pytest
import torch
from nerfstudio.scripts import eval as evaluate
from nerfstudio.scripts import exporter
from nerfstudio.utils.eval_utils import eval_setup

from ns_commands import Run, started
from pointsplat_ns.io import read_ply


def test_eval_writes_numbers_and_pictures_of_the_held_out_photo(run: Run, no_lpips, tmp_path):
    path = tmp_path / "eval.json"
    started(evaluate, "--load-config", run.config, "--output-path", path, "--render-output-path", tmp_path / "pictures")
    report = json.loads(path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert report["method_name"] == run.method
    assert report["results"]["psnr"] > 8 and 0 < report["results"]["ssim"] <= 1
    assert report["results"]["lpips"] is None and "no network" in report["results"]["lpips_note"]
    assert any(file.is_file() for file in (tmp_path / "pictures").rglob("*"))


def test_export_writes_the_gaussians_that_are_drawn(run: Run, tmp_path):
    started(exporter, "gaussian-splat", "--load-config", run.config, "--output-dir", tmp_path)
    _, pipeline, _, _ = eval_setup(run.config, test_mode="inference")
    seen = pipeline.model.opacities[:, 0] >= -5.5373  # ns-export drops opacities below 1/255
    written = read_ply(tmp_path / "splat.ply")
    assert len(written) == int(seen.sum()) > 0 and torch.equal(written.means, pipeline.model.means[seen].detach())
