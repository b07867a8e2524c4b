"""Cleaning: planted junk goes, what is seen stays, counts are exact, and extremes change
nothing."""

import functools
import math
from collections.abc import Iterator

import pytest
import torch

import pointsplat_ns as ps
from making import box_room, same_bits, splats
from pointsplat_ns.errors import DataError
from pointsplat_ns.pipeline import cleaning
from pointsplat_ns.pipeline.cleaning import (
    FLOATING,
    PLACES,
    Rule,
    clean_scene,
    find_junk,
    floating_scores,
)
from pointsplat_ns.pipeline.options import PruneOptions
from pointsplat_ns.pipeline.prune_scene import prune_scene
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.pruning import WithinPsnr, resolve_keep
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.view_sampling.sampler import sample_views

ROOM = 5500
THINGS = 3000
PLANTED = 12


@pytest.fixture(scope="module", autouse=True)
def few_places() -> Iterator[None]:
    """Four places instead of sixteen, in a quarter of the time, for tests of what does not depend
    on their number."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cleaning, "PLACES", 4)
        yield


@pytest.fixture(scope="module")
def room() -> Gaussians:
    """Opaque walls of many layers, through which nothing shines, and small things before them,
    which are seen from inside."""
    walls = box_room(0, ROOM - THINGS, size=0.2)
    things = box_room(1, THINGS, size=0.03)
    whole = Gaussians.cat([walls, things.replace(means=0.8 * things.means)])
    return whole.replace(opacities=torch.full((ROOM, 1), 9.0))


@pytest.fixture(scope="module")
def views(room) -> Views:
    return sample_views(room, 3, 64, 48)


blobs = functools.partial(splats, colours=1.0, degree=1)
"""Grey Gaussians, of the SH degree of the room."""


def behind_the_walls(n: int = PLANTED) -> torch.Tensor:
    """Points one unit beyond the walls that face along x, (n, 3). The walls are at 2 and about 0.5
    thick."""
    side = torch.where(torch.arange(n) % 2 == 0, 1.0, -1.0)
    spread = torch.linspace(-0.8, 0.8, n)
    return torch.stack([3.2 * side, spread, spread.flip(0) * 0.5], dim=1)


JUNK = {
    "floaters": blobs(behind_the_walls(), math.log(0.05), 4.0),
    "giants": blobs(behind_the_walls() * torch.tensor([4.0, 1.0, 1.0]), math.log(2.0), 4.0),
    "haze": blobs(behind_the_walls(), math.log(0.3), -4.5),
}
"""What is behind the walls of the room, by kind."""


def junk_of(scene: Gaussians) -> tuple[list[int], list[int]]:
    junk = find_junk(scene)
    return sorted(junk.undrawable.tolist()), sorted(junk.unseen.tolist())


def with_junk(room: Gaussians) -> Gaussians:
    """The room, then floaters and haze behind its walls, then what cannot be drawn: one NaN and one
    too faint."""
    bad = blobs(torch.tensor([[math.nan, 0.0, 0.0], [0.0, 0.0, 0.0]]), -2.0, -9.0)
    return Gaussians.cat([room, JUNK["floaters"], JUNK["haze"], bad])


def test_nothing_of_a_clean_room_is_touched():
    thin = box_room(0)  # every Gaussian of its walls is seen
    assert junk_of(thin) == ([], [])
    result = prune_scene(thin, PruneOptions(0.4, "opacity", clean=True))
    assert same_bits(result.scene, prune_scene(thin, PruneOptions(0.4, "opacity")).scene)
    assert result.cleaning is not None and result.cleaning.effects == ()


@pytest.mark.parametrize("kind", JUNK)
def test_what_is_behind_walls_goes_and_no_view_changes(kind, room, views, monkeypatch):
    monkeypatch.setattr(cleaning, "PLACES", PLACES)
    scene = Gaussians.cat([room, JUNK[kind]])
    undrawable, unseen = junk_of(scene)
    assert undrawable == [] and unseen[-PLANTED:] == list(range(ROOM, ROOM + PLANTED))
    assert len(unseen) <= 3 * PLANTED, "of the walls only a few that are behind others"
    assert DenseReference(scene, views).psnr(room)[0] == math.inf  # views that chose nothing


def test_what_cannot_be_drawn_goes_the_meaningless_first(room):
    bad = blobs(torch.zeros(3, 3), -2.0, 0.0)
    bad.opacities[:, 0] = torch.tensor([-7.0, -8.0, 3.0])
    bad.scales[2, 1] = math.inf
    junk = find_junk(Gaussians.cat([bad, room]))
    assert junk.undrawable.tolist() == [2, 1, 0]


@pytest.mark.parametrize(
    ("scene", "most"),
    [
        (box_room(0, 30).replace(scales=torch.full((30, 3), 80.0)), 29),
        # The first of opacity 0.98 let 2 % through each; when a ten-thousandth is left the others
        # are not drawn.
        (box_room(0, 30).replace(means=torch.zeros(30, 3), scales=torch.full((30, 3), -1.0)), 28),
        (
            box_room(0, 30).replace(
                means=torch.full((30, 3), 1e30), scales=torch.full((30, 3), -1.0)
            ),
            28,
        ),
    ],
    ids=["giants without end", "in one place", "in one place far away"],
)
def test_of_alike_ones_those_that_show_stay(scene, most):
    undrawable, unseen = junk_of(scene)
    assert undrawable == [] and len(unseen) <= most


@pytest.mark.parametrize(
    ("by", "keep"), [("merge", 0.3), ("merge", 0.999), ("opacity", 1), ("opacity", 1.0)]
)
def test_keep_refers_to_the_scene_as_read_and_is_exact(by, keep, room, views):
    scene = with_junk(room)[:-2] if by == "merge" else with_junk(room)
    result = prune_scene(
        scene, PruneOptions(keep, by, clean=True), ViewProvider(scene, given=views)
    )
    assert len(result.scene) == resolve_keep(len(scene), keep)
    if keep == 0.3:
        assert int((result.scene.means[:, 0].abs() > 3).sum()) == 0


def test_a_quality_that_takes_junk_gets_it_back(room, views):
    scene = Gaussians.cat([room, JUNK["floaters"]])
    source = ViewProvider(scene, given=views)
    easy = prune_scene(scene, PruneOptions(WithinPsnr(12.0), "coverage", clean=True), source)
    assert len(easy.scene) < ROOM and int((easy.scene.means[:, 0].abs() > 3).sum()) == 0
    cleaning_of = clean_scene(scene, 1, source)
    for count in (len(scene), len(scene) - 1, len(scene) - 5):
        assert len(cleaning_of.apply(scene, count)) == count


def test_without_a_free_place_or_views_only_the_undrawable_go(monkeypatch):
    def nowhere(*_, **options):
        raise DataError("no free place to look from was found")

    monkeypatch.setattr("pointsplat_ns.view_sampling.sampler.Sampler.views", nowhere)
    scene = with_junk(box_room(0, 40, size=0.05))
    junk = find_junk(scene)
    assert junk.places == 0 and len(junk.unseen) == 0
    undrawable, unseen = clean_scene(scene, 1, ViewProvider(scene)).effects
    assert (undrawable.rule, undrawable.removed) == (Rule.UNDRAWABLE, 2)
    assert (unseen.rule, unseen.removed, unseen.places) == (Rule.UNSEEN, 0, 0)


def before_a_wall(unit: float = 1.0) -> tuple[Gaussians, Views]:
    """A grey wall at 4, and before it, at 1, haze of its colour, then a red opaque blob; and two
    views of them."""
    across = torch.linspace(-4, 4, 25)
    wall = torch.cartesian_prod(across, across, torch.tensor([4.0]))
    before = torch.tensor([[-0.3, 0.0, 1.0], [0.3, 0.0, 1.0]])
    scene = blobs(torch.cat([wall, before]), math.log(0.2), 9.0)
    scene.features_dc[:] = 0.0
    scene.features_dc[-1] = torch.tensor([1.5, -1.5, -1.5])
    scene.opacities[-2] = -1.0
    scene = scene.replace(means=scene.means * unit, scales=scene.scales + math.log(unit))
    viewmats = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    viewmats[1, 0, 3] = 0.2 * unit
    K = torch.tensor([[24.0, 0.0, 16.0], [0.0, 24.0, 12.0], [0.0, 0.0, 1.0]])
    return scene, Views(viewmats, K.repeat(2, 1, 1), 32, 24, torch.zeros(3), near_plane=0.01 * unit)


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_haze_before_a_wall_floats_and_a_red_blob_stays(unit):
    scene, views = before_a_wall(unit)
    junk = find_junk(scene, floating=views, strength=0.5)
    assert junk.floating.tolist() == [len(scene) - 2]
    assert len(find_junk(scene, floating=views).floating) == 0, "strength 0"


def test_what_a_given_view_shows_is_not_unseen(room):
    """A view from behind the walls, where nobody looks from otherwise."""
    scene = Gaussians.cat([room, JUNK["floaters"]])
    viewmat = torch.tensor(
        [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 6.0], [0.0, 0.0, 0.0, 1.0]]
    )
    K = torch.tensor([[32.0, 0.0, 16.0], [0.0, 32.0, 16.0], [0.0, 0.0, 1.0]])
    behind = Views(viewmat[None].double(), K[None], 32, 32, torch.zeros(3))
    near = {*range(ROOM + 1, ROOM + PLANTED, 2)}  # those on the side of the camera
    cleanings = [
        clean_scene(scene, 1, source)
        for source in (ViewProvider(scene, given=behind), ViewProvider(scene))
    ]
    assert [near & {*cleaning.junk.unseen.tolist()} for cleaning in cleanings] == [set(), near]
    assert not any(len(cleaning.junk.floating) for cleaning in cleanings)
    rules = {effect.rule for cleaning in cleanings for effect in cleaning.effects}
    assert rules == {Rule.UNSEEN}


def test_the_score_is_its_formula():
    """Weights of each Gaussian at each pixel by rendering one channel each, in float64."""
    scene, views = before_a_wall()
    scene = scene.to(torch.float64)[scene.means[:, :2].norm(dim=1) < 1.9]
    totals = torch.zeros(3, len(scene), dtype=torch.float64)
    colors = (0.5 + 0.28209479177387814 * scene.features_dc).clamp(0, 1)
    for view in views:
        camera = {
            "viewmats": view.viewmat[None],
            "Ks": view.K[None].double(),
            "width": 32,
            "height": 24,
        }
        shape = scene.means, scene.quats, scene.stds, scene.alphas
        weights = ps.rasterization(*shape, torch.eye(len(scene), dtype=torch.float64), **camera)[0][
            0
        ]  # [H, W, N]
        depths = scene.means[:, 2]
        shown = (weights @ depths / weights.sum(-1)).nan_to_num(1.0)
        apart = (weights @ colors)[:, :, None] - colors
        totals[0] += weights.sum((0, 1))
        totals[1] += (weights * (1 - depths / shown[..., None])).sum((0, 1))
        totals[2] += (weights * apart.square().sum(-1)).sum((0, 1))
    free = totals[1] / totals[0]
    difference = (totals[2] / totals[0]).clamp_min(1e-4)
    expected = (difference / free).sqrt() / FLOATING
    found = {
        dtype: floating_scores(scene.to(dtype), views)[0]
        for dtype in (torch.float32, torch.float64)
    }
    before = free > 0.01  # the wall stands before nothing, to rounding
    assert before.tolist() == [False] * (len(scene) - 2) + [True] * 2
    # float32 depths are within 1e-6 of their size, free is at least 0.01
    for dtype, within in ((torch.float32, 1e-3), (torch.float64, 1e-9)):
        torch.testing.assert_close(found[dtype][before], expected[before], rtol=within, atol=0)


@pytest.mark.parametrize("opacity", [40.0, -4.0])
def test_what_stands_before_nothing_never_floats(opacity):
    """One Gaussian, and opaque or faint walls without anything before them."""
    scene, views = before_a_wall()
    scene = scene.replace(opacities=torch.full_like(scene.opacities, opacity))
    for some in (scene[:1], scene[-1:], scene[:-2]):
        assert bool((floating_scores(some, views)[0] > 1).all())
    assert floating_scores(scene[:0], views)[0].shape == (0,)


def test_values_that_are_not_finite_are_no_floaters():
    scene, views = before_a_wall()
    odd = blobs(torch.tensor([[0.0, 0.0, 1.0]] * 4), 0.0, 1.0)
    odd.means[0, 0] = math.nan
    odd.scales[1, 1] = 1e4
    odd.opacities[2] = -math.inf
    odd.features_dc[3, 0] = 1e38
    junk = find_junk(Gaussians.cat([odd, scene]), floating=views, strength=1)
    assert set(junk.undrawable.tolist()) >= {0, 2} and not {0, 1, 2} & {*junk.floating.tolist()}


def test_clean_keeps_the_others_bit_for_bit_and_at_least_one(tmp_path):
    scene, views = before_a_wall()
    cleaned = ps.clean(scene, views=views, picture=tmp_path / "gone.png")
    assert same_bits(cleaned, scene[[*range(len(scene) - 2), len(scene) - 1]])
    assert (tmp_path / "gone.png").read_bytes()[:4] == b"\x89PNG"
    assert len(ps.clean(scene[:1], 1.0, views=views, picture=tmp_path / "none.png")) == 1
    faint = scene.replace(opacities=torch.full_like(scene.opacities, -20.0))
    assert len(ps.clean(faint, views=views)) == 1
    with pytest.raises(ps.SceneError, match="can be drawn"):
        ps.clean(scene.replace(means=scene.means * math.nan))
    for strength in (-0.1, 1.1, math.nan):
        with pytest.raises(ps.PointSplatError, match=r"expected a number in \[0, 1\]"):
            ps.clean(scene, strength)
