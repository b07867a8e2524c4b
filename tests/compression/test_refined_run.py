"""A trained pointsplat run, opened without nerfstudio."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: completes its imports in the order that it can)
from pointsplat_ns.compression.refined_run import open_refined_run, prune_options
from pointsplat_ns.errors import BudgetError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning import prune


def random_scene(n: int = 60, degree: int = 3) -> Gaussians:
    generator = torch.Generator().manual_seed(7)

    def normal(*shape):
        return torch.randn(shape, generator=generator)

    return Gaussians(
        means=normal(n, 3),
        scales=normal(n, 3) - 3,
        quats=normal(n, 4),
        opacities=normal(n, 1),
        features_dc=normal(n, 3),
        features_rest=0.1 * normal(n, (degree + 1) ** 2 - 1, 3),
    )


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_scene_of_any_size_and_degree_is_pruned_and_refined(make_refined_run, trained_walls, tmp_path, degree):
    opened = open_refined_run(make_refined_run(tmp_path, trained_walls, moved=0.25, keep=0.4, score="opacity"))
    dense = random_scene(degree=degree)
    compact = opened.compact(dense)
    kept = prune(dense, 0.4, "opacity").scene
    assert len(compact) == 24 and compact.sh_degree == degree
    assert torch.equal(compact.opacities, kept.opacities + 0.25) and torch.equal(compact.means, kept.means)
    assert not compact.means.requires_grad and not opened.refiner.training
    assert len(opened.compact(dense, keep=7)) == 7 and len(opened.compact(dense, keep=0.1)) == 6
    with pytest.raises(BudgetError, match="keep is 61 Gaussians; expected 1 to 60"):
        opened.compact(dense, keep=61)


def test_scenes_are_known_by_name_and_the_first_held_out_is_the_default(make_refined_run, trained_walls, tmp_path):
    opened = open_refined_run(make_refined_run(tmp_path / "1", trained_walls))
    assert list(opened.scenes) == ["wall-a", "wall-b"] and opened.default_scene == "wall-a"
    assert all(path.suffix == ".ckpt" and path.is_file() for path in opened.scenes.values())
    opened = open_refined_run(make_refined_run(tmp_path / "2", trained_walls, ("wall-b",)))
    assert opened.default_scene == "wall-b"
    # The viewer and ns-export show the first held-out scene by name, whatever the order on the command line was.
    opened = open_refined_run(make_refined_run(tmp_path / "3", trained_walls, ("wall-b", "wall-a")))
    assert opened.default_scene == "wall-a"


def test_the_refiner_alone_needs_no_scenes(make_refined_run, tmp_path):
    run = make_refined_run(tmp_path, Path("/not/on/this/machine"))
    opened = open_refined_run(run, need_scenes=False)
    assert opened.scenes == {} and opened.default_scene == ""
    with pytest.raises(SceneError, match="config.yml: its data .*is not there"):
        open_refined_run(run)


def test_it_opens_in_a_process_that_has_not_loaded_nerfstudio(make_refined_run, tmp_path):
    run = make_refined_run(tmp_path, Path("nowhere"))
    code = (
        "import sys; from pointsplat_ns.compression.refined_run import open_refined_run; "
        f"open_refined_run({str(run)!r}, need_scenes=False); assert 'nerfstudio' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_other_runs_and_damaged_ones_are_refused_in_one_line(make_refined_run, trained_walls, tmp_path):
    (splatfacto,) = (trained_walls / "wall-a" / "splatfacto-cpu").iterdir()
    with pytest.raises(SceneError, match="a run of the method splatfacto-cpu; expected a pointsplat run"):
        open_refined_run(splatfacto)
    with pytest.raises(SceneError, match="no such file or folder"):
        open_refined_run(tmp_path / "nothing")
    run = make_refined_run(tmp_path / "size", trained_walls)
    config = run / "config.yml"
    text = config.read_text()
    for change, message in (
        (("size: tiny", "size: small"), "not a usable pointsplat checkpoint"),
        (("size: tiny", "size: huge"), "config.yml: .*huge"),
        (("size: tiny\n", "sighs: tiny\n"), "config.yml: lacks 'size'"),
        (("keep: 0.5", "keep: 1.5"), r"config.yml: keep is 1.5; expected a ratio"),
        (("keep: 0.5", "keep: half"), "half"),
    ):
        assert change[0] in text
        config.write_text(text.replace(*change))
        with pytest.raises(SceneError, match=message) as caught:
            open_refined_run(run, need_scenes=False)
        assert "\n" not in str(caught.value) and str(run) in str(caught.value)
    config.write_text(text)
    checkpoint = run / "nerfstudio_models" / "step-000000009.ckpt"
    whole = checkpoint.read_bytes()
    checkpoint.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SceneError, match="no complete checkpoint"):
        open_refined_run(run, need_scenes=False)
    torch.save({"step": 9, "pipeline": {}}, checkpoint)
    with pytest.raises(SceneError, match="step-000000009.ckpt: not a usable pointsplat checkpoint"):
        open_refined_run(run, need_scenes=False)


def test_code_in_the_config_is_never_run(make_refined_run, tmp_path):
    run = make_refined_run(tmp_path, Path("nowhere"))
    config, trap = run / "config.yml", tmp_path / "sprung"
    config.write_text(
        config.read_text().replace("keep: 0.5", f"keep: !!python/object/apply:os.system ['touch {trap}']")
    )
    with pytest.raises(SceneError):
        open_refined_run(run, need_scenes=False)
    assert not trap.exists()


def test_prune_options_tell_ratios_from_counts():
    assert prune_options(0.3, "paper", 0.2) == {"keep": 0.3, "by": "paper", "opacity_weight": 0.2}
    assert prune_options(500.0, "volume", 0.2) == {"keep": 500, "by": "volume"}
    assert type(prune_options(1, "volume", 0.2)["keep"]) is float, "1 is everything, as 1.0 is"
    for keep in (0.0, -1.0, 1.5, 2.5, math.nan, math.inf):
        with pytest.raises(BudgetError, match="keep is .*expected a ratio"):
            prune_options(keep, "paper", 0.3)
