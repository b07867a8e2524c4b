"""A scene made smaller and refined: refinement is kept where it helps, left out where it does not, and it is said."""

from __future__ import annotations

import importlib.resources
import math
import subprocess
import sys

import pytest
import torch

import pointsplat_ns.compression.compact as shipped
from making import ball, same
from pointsplat_ns.compression.budget_search import DenseReference
from pointsplat_ns.compression.compact import (
    WORTH,
    TrainedRefiner,
    at_strength,
    bottom_of_parabola,
    compact_and_refine,
    load_shipped,
    load_trained,
)
from pointsplat_ns.compression.prune import compact_scene
from pointsplat_ns.compression.view_sampling import sample_views
from pointsplat_ns.errors import BudgetError, DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning import WithinPsnr, compact
from pointsplat_ns.refiner import Refiner, WeightsError, preset, save_refiner
from pointsplat_ns.refiner.config import RefinerConfig

TINY = {"enc_channels": (8, 8), "enc_depths": (1, 1), "enc_heads": (1, 1), "strides": (2,), "patch": 64}
TINY |= {"dec_channels": (8,), "dec_depths": (1,), "dec_heads": (1,), "feature_dim": 8, "head_width": 8, "grid": None}


def room(n: int = 400, degree: int = 1) -> Gaussians:
    """As faint as merging never leaves it."""
    return ball(n, degree, opacity=1.0, bright=1.0)


def tiny_refiner(head: str = "opacities", moved: float = 0.0, seed: int = 1, **config) -> Refiner:
    """An untrained refiner whose residual is ``moved`` for every value of one attribute, zero for the others."""
    torch.manual_seed(seed)
    refiner = Refiner(RefinerConfig(**{**TINY, **config})).eval()
    with torch.no_grad():
        [*refiner.heads.mlps[head].modules()][-1].bias.fill_(moved)
    return refiner


def trained(refiner: Refiner, keep: float | int = 0.5, by: str = "opacity", **options) -> TrainedRefiner:
    return TrainedRefiner(refiner, {"keep": keep, "by": by, **options}, "in memory")


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return room()


@pytest.fixture(scope="module")
def looks(scene):
    return sample_views(scene, 3, 48, 36)


def test_a_refiner_that_helps_is_kept_and_the_figures_are_those_of_the_renders(scene, looks):
    # Half of the blobs are gone, the most opaque are left: larger ones close the holes.
    helps = trained(tiny_refiner("scales", 0.1))
    made = compact_and_refine(scene, helps, poses=lambda count: looks)
    kept = compact(scene, 0.5, "opacity")
    larger = kept.replace(scales=kept.scales + 0.1)
    assert (
        made.helped
        and made.strength == 1
        and same(made.compacted, kept)
        and same(made.scene, larger)
        and same(made.refined, larger)
    )
    reference = DenseReference(scene, looks)
    before, after = reference.psnr(kept), reference.psnr(larger)
    assert after[0] > before[0] + 0.5, "the test's own refiner does not help"
    assert (made.before.psnr, made.before.worst) == before and (made.after.psnr, made.after.worst) == after
    assert f"refinement: {before[0]:.2f} -> {after[0]:.2f} dB" in made.verdict and "in 3 views" in made.verdict
    assert f"worst view {before[1]:.2f} -> {after[1]:.2f} dB" in made.verdict and "closer in 3 of 3" in made.verdict
    assert f"SSIM {made.before.ssim:.3f} -> {made.after.ssim:.3f}" in made.verdict


def test_a_refiner_that_harms_is_left_out_and_both_figures_are_said(scene, looks):
    made = compact_and_refine(scene, trained(tiny_refiner("features_dc", 2.0)), poses=lambda count: looks)
    assert not made.helped and same(made.scene, compact(scene, 0.5, "opacity")) and not same(made.refined, made.scene)
    assert made.after.psnr < made.before.psnr
    assert made.verdict.startswith("refinement left out, it does not help: ")
    assert f"{made.before.psnr:.2f} -> {made.after.psnr:.2f} dB" in made.verdict and "closer in 0 of 3" in made.verdict


def test_a_refiner_that_goes_too_far_is_taken_part_of_the_way(scene, looks):
    far = trained(tiny_refiner("scales", 0.8))
    kept, reference = compact(scene, 0.5, "opacity"), DenseReference(scene, looks)
    made = compact_and_refine(scene, far, poses=lambda count: looks)
    assert reference.psnr(far(kept))[0] < made.before.psnr, "the test's own refiner does not go too far"
    assert made.helped and 0.05 < made.strength < 0.5
    assert f"refinement at {made.strength:.0%} of its strength: {made.before.psnr:.2f} -> " in made.verdict
    assert torch.allclose(made.scene.scales, kept.scales + 0.8 * made.strength) and torch.equal(
        made.scene.means, kept.means
    )
    shares = torch.linspace(0, 1, 21).tolist()
    best = max(reference.psnr(at_strength(kept, far(kept), share))[0] for share in shares)
    # Most of what there is to gain, not all: the errors are no exact parabola.
    assert made.after.psnr - made.before.psnr > 2 / 3 * (best - made.before.psnr) > 0


def test_what_brings_next_to_nothing_is_left_out(scene, looks, monkeypatch):
    for worth, helped in ((WORTH, False), (0.001, True)):
        monkeypatch.setattr(shipped, "WORTH", worth)
        made = compact_and_refine(scene, trained(tiny_refiner("scales", 0.002)), poses=lambda count: looks)
        assert made.helped == helped and made.before.psnr < made.after.psnr < made.before.psnr + WORTH
    monkeypatch.undo()
    made = compact_and_refine(scene, trained(tiny_refiner("scales", 0.002)), poses=lambda count: looks)
    assert made.verdict.startswith("refinement left out, it brings less than 0.1 dB: ")


def test_a_share_of_the_way_is_linear_in_what_is_stored_and_finite_where_the_start_is():
    before = room(20)
    before.opacities[0], before.scales[1, 2] = math.inf, -math.inf
    after = before.map(lambda value: value + 2.0)
    after.opacities[2] = math.inf
    assert at_strength(before, after, 1) is after and same(at_strength(before, after, 0.0), before)
    half = at_strength(before, after, 0.5)
    assert torch.allclose(half.means, before.means + 1.0) and bool(half.usable().all())
    assert half.opacities[0] == math.inf and half.scales[1, 2] == -math.inf
    assert half.opacities[2] == before.opacities[2]
    huge = before.replace(means=torch.full_like(before.means, 3e38))
    mixed = at_strength(huge, huge.replace(means=-huge.means), 0.5)  # their difference overflows
    assert bool(mixed.means.isfinite().all())


@pytest.mark.parametrize("scale", [1e-300, 1e-12, 1.0])
def test_the_bottom_of_a_parabola_is_found_whatever_its_scale(scale):
    for bottom in (0.1, 0.3, 0.5, 0.97):
        values = [scale * (3 * (s - bottom) ** 2 + 0.2) for s in (0.0, 0.5, 1.0)]
        assert bottom_of_parabola(*values) == pytest.approx(bottom, abs=1e-9)
    assert bottom_of_parabola(*[scale * value for value in (3, 2, 1)]) == 1.0  # a line
    assert bottom_of_parabola(*[scale * value for value in (1, 2, 3)]) == 0.0
    assert bottom_of_parabola(*[scale * value for value in (1, 2, 1)]) == 0.0  # bent the other way
    assert bottom_of_parabola(*[scale * value for value in (5, 2, 1)]) == pytest.approx(1.0)
    assert bottom_of_parabola(0.0, 0.0, 0.0) == 0.0
    assert math.isnan(bottom_of_parabola(scale, math.nan, scale)) and math.isnan(bottom_of_parabola(math.inf, 1, 1))


def test_an_untrained_refiner_changes_nothing_and_it_is_said(scene, looks):
    made = compact_and_refine(scene, trained(tiny_refiner()), poses=lambda count: looks)
    assert not made.helped and "left out: it changes nothing" in made.verdict and same(made.scene, made.refined)
    whole = compact_and_refine(scene, trained(tiny_refiner("scales", 0.1)), 1.0, poses=lambda count: looks)
    assert not whole.helped and same(whole.scene, scene) and whole.before.psnr == math.inf


def test_what_is_not_finite_never_gets_out(scene, looks):
    kept = compact(scene, 0.5, "opacity")
    refiner = tiny_refiner("features_dc", math.nan)  # the refiner itself holds back what it cannot compute
    made = compact_and_refine(scene, trained(refiner), poses=lambda count: looks)
    assert not made.helped and same(made.scene, kept)

    class Unsound(Refiner):
        def forward(self, scene, structure=None):
            means = scene.means.clone()
            means[:7] = math.nan
            return scene.replace(means=means)

    unsound = Unsound(refiner.config).eval()
    for poses in (lambda count: looks, nowhere):
        made = compact_and_refine(scene, trained(unsound), poses=poses)
        assert not made.helped and same(made.scene, kept) and made.after is None
        assert made.verdict == "refinement left out: 7 of 200 refined Gaussians are not finite"


def nowhere(count):
    raise DataError("no free place to look at the scene from was found")


def test_without_a_place_to_look_from_refinement_is_left_out_and_the_reason_is_said(scene):
    made = compact_and_refine(scene, trained(tiny_refiner("scales", 0.2)), poses=nowhere)
    assert not made.helped and same(made.scene, compact(scene, 0.5, "opacity")) and made.reference is None
    assert made.verdict == (
        "refinement left out: it cannot be compared with the dense scene (no free place to look at the scene from was "
        "found)"
    )


def test_one_gaussian_is_compacted_and_none_are_refused(scene):
    one = scene[5:6].replace(opacities=torch.tensor([[4.0]]))
    for moved in (0.0, 0.3):  # nothing is closer to a scene than itself
        made = compact_and_refine(one, trained(tiny_refiner("scales", moved), 1))
        assert len(made.scene) == 1 and same(made.scene, one) and not made.helped
        assert made.notes == ("poses sampled in free space",) and made.before.psnr == math.inf
    faint = one.replace(opacities=torch.tensor([[-4.0]]))  # no place sees a covered picture of it
    made = compact_and_refine(faint, trained(tiny_refiner("scales", 0.3), 1))
    assert same(made.scene, faint) and "cannot be compared" in made.verdict and made.notes == ()
    with pytest.raises(SceneError, match="can be drawn"):
        compact_and_refine(scene[:0], trained(tiny_refiner()))
    with pytest.raises(SceneError, match="can be drawn"):
        compact_and_refine(scene.map(lambda value: value * math.nan), trained(tiny_refiner()))


def test_what_is_asked_for_goes_before_what_the_refiner_was_trained_with(scene, looks):
    refiner = trained(tiny_refiner(), 0.25, "paper", opacity_weight=0.9)
    made = compact_and_refine(scene, refiner, poses=lambda count: looks)
    assert same(made.compacted, compact(scene, 0.25, "paper", opacity_weight=0.9))
    made = compact_and_refine(scene, refiner, 30, "merge", "0", poses=lambda count: looks)
    assert same(made.compacted, compact_scene(scene, 30, "merge", "0").scene) and made.scene.sh_degree == 0
    with pytest.raises(BudgetError, match="keep is 401"):
        compact_and_refine(scene, refiner, 401)


def test_a_wanted_psnr_is_met_before_refinement_so_in_any_case(scene, looks):
    for moved in (2.0, -0.05):
        refiner = trained(tiny_refiner("features_dc", moved))
        made = compact_and_refine(scene, refiner, WithinPsnr(24.0), "coverage", poses=lambda count: looks)
        assert made.before.psnr >= 24 and DenseReference(scene, looks).psnr(made.scene)[0] >= made.before.psnr
        assert any("renders reach" in note for note in made.notes)


def test_a_degree_above_the_networks_is_refused_before_anything_is_done(scene, looks, monkeypatch):
    refiner = trained(tiny_refiner(sh_degree=0))
    with monkeypatch.context() as patch:
        patch.setattr(shipped, "compact_scene", None)
        with pytest.raises(SceneError, match="has SH degree 1; .* at most 0; cut it with --sh 0"):
            compact_and_refine(scene, refiner, sh="1", poses=lambda count: looks)
    assert compact_and_refine(scene, refiner, sh="0", poses=lambda count: looks).scene.sh_degree == 0
    strong = scene.replace(features_rest=scene.features_rest * 20)  # auto keeps the band: only now it is known
    with pytest.raises(SceneError, match="SH degree 1.*at most 0"):
        compact_and_refine(strong, refiner, sh="auto", poses=lambda count: looks)


def test_views_smaller_than_the_window_of_ssim_are_compared_by_psnr_alone(scene):
    made = compact_and_refine(scene, trained(tiny_refiner("scales", 0.2)), poses=lambda n: sample_views(scene, 2, 8, 6))
    assert made.after.ssim is None and "SSIM" not in made.verdict and "in 2 views" in made.verdict


def test_progress_names_what_is_done_and_never_goes_back(scene, looks):
    told = []
    compact_and_refine(
        scene,
        trained(tiny_refiner("scales", 0.2), by="merge"),
        poses=lambda count: looks,
        progress=lambda what, share: told.append((what, share)),
    )
    assert list(dict.fromkeys(what for what, _ in told)) == ["by merge", "refining", "comparing renders"]
    shares = [share for what, share in told if what == "comparing renders"]
    assert shares == sorted(shares) and shares[-1] == 1 and all(0 <= share <= 1 for _, share in told)


def test_a_file_of_weights_says_what_it_was_trained_with(tmp_path):
    refiner = tiny_refiner("scales", 0.2)
    for metadata, options in (
        ({}, {"keep": 0.1, "by": "merge"}),
        ({"keep": 0.3, "score": "coverage", "steps": 5}, {"keep": 0.3, "by": "coverage"}),
        (
            {"keep": "0.3", "score": "paper", "opacity_weight": "0.7"},
            {"keep": 0.3, "by": "paper", "opacity_weight": 0.7},
        ),
        ({"keep": 500}, {"keep": 500, "by": "merge"}),
    ):
        save_refiner(refiner, tmp_path / "r.safetensors", metadata)
        loaded = load_trained(tmp_path / "r.safetensors")
        assert loaded.prune_options == options and not loaded.refiner.training
    scene = room(60)
    assert same(loaded(scene), scene.replace(scales=scene.scales + 0.2))
    for metadata in ({"keep": "some"}, {"keep": 1.5}, {"score": "best"}, {"keep": None}, {"opacity_weight": []}):
        save_refiner(refiner, tmp_path / "r.safetensors", metadata)
        with pytest.raises(WeightsError, match="r.safetensors: metadata not understood") as caught:
            load_trained(tmp_path / "r.safetensors")
        assert "\n" not in str(caught.value)


def test_a_run_is_a_refiner_too_and_anything_else_is_refused(make_refined_run, tmp_path):
    run = make_refined_run(tmp_path, tmp_path / "nowhere", moved=0.5, keep=0.25, score="opacity")
    loaded = load_trained(run)
    assert loaded.prune_options == {"keep": 0.25, "by": "opacity"} and loaded.source == run
    scene = room(60)
    assert same(loaded(scene), scene.replace(opacities=scene.opacities + 0.5))
    (tmp_path / "scene.ply").touch()
    with pytest.raises(WeightsError, match="scene.ply: a .ply file; expected a trained pointsplat run"):
        load_trained(tmp_path / "scene.ply")
    with pytest.raises(SceneError, match="no such file"):
        load_trained(tmp_path / "gone")
    with pytest.raises(WeightsError, match="no such file"):
        load_trained(tmp_path / "gone.safetensors")


def test_where_the_shipped_refiner_is_missing_it_is_said_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "SHIPPED", tmp_path / "refiner.safetensors")
    with pytest.raises(WeightsError, match="not there; .*--using RUN_OR_FILE, or .*pointsplat make-refiner") as caught:
        load_shipped()
    assert "\n" not in str(caught.value)
    save_refiner(Refiner(preset("tiny")), shipped.SHIPPED, {"keep": 0.2})
    assert load_shipped().prune_options == {"keep": 0.2, "by": "merge"}


def test_the_installed_package_holds_the_shipped_refiner_and_its_card():
    folder = importlib.resources.files("pointsplat_ns") / "weights"
    if not (folder / "refiner.safetensors").is_file():
        pytest.skip("the refiner that ships has not been trained yet (pointsplat make-refiner)")
    assert shipped.SHIPPED.samefile(str(folder / "refiner.safetensors"))
    assert shipped.SHIPPED.stat().st_size <= 10e6 and (folder / "CARD.md").is_file()
    loaded = load_shipped()
    scene = room(60, degree=3)
    assert len(loaded(scene)) == 60 and bool(loaded(scene).usable().all())


def test_the_weights_are_named_as_package_data():
    from fnmatch import fnmatch
    from pathlib import Path

    if sys.version_info < (3, 11):
        pytest.skip("tomllib came with Python 3.11")
    import tomllib

    settings = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    patterns = settings["tool"]["setuptools"]["package-data"]["pointsplat_ns"]
    for name in ("weights/refiner.safetensors", "weights/CARD.md"):
        assert any(fnmatch(name, pattern) for pattern in patterns)


def test_it_is_imported_without_nerfstudio():
    code = "import sys; import pointsplat_ns.compression.compact; assert 'nerfstudio' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
