"""Densification with a cap: its formulas against plain twins, and whole trainings that end with that many Gaussians."""

import math
from fractions import Fraction

import pytest
import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.capped import (
    CappedStrategy,
    position_noise,
    shared_opacity,
)
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import fitted_schedules, splatfacto_cpu_config
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.model import SplatfactoCpuModelConfig
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.seeds import random_seeds_near_cameras

SEED = 20


def by_binomials(opacity: float, copies: int) -> tuple[float, float]:
    """Opacity and factor of the scales by the paper's equation 9, whose binomials are summed without rounding."""
    shared = -math.expm1(math.log1p(-opacity) / copies)
    exact = Fraction(shared)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * exact ** (k + 1) * Fraction(1 / math.sqrt(k + 1))
        for i in range(1, copies + 1)
        for k in range(i)
    )
    return shared, opacity / float(total)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("copies", [1, 2, 51])
@pytest.mark.parametrize("opacity", [1e-12, 0.3, 0.999999])
def test_opacity_and_size_are_shared_as_the_paper_has_it(opacity, copies, dtype):
    logit = torch.tensor([math.log(opacity) - math.log1p(-opacity)], dtype=dtype)
    scales = torch.tensor([[-60.0, 0.0, 20.0]], dtype=dtype)
    given = float(torch.sigmoid(logit.double()))  # what the dtype makes of the opacity
    opacities, shared = shared_opacity(logit, scales, torch.tensor([copies]))
    expected, factor = by_binomials(given, copies)
    # The root of 1/(k + 1) is rounded in float64, and binomials of 50 multiply that by a thousand.
    tolerance = {torch.float32: 2e-6, torch.float64: 1e-11}[dtype]
    assert opacities.dtype == shared.dtype == dtype
    assert float(torch.sigmoid(opacities.double())) == pytest.approx(expected, rel=tolerance)
    moves = shared.double() - scales.double()
    # A float32 of 60 is rounded to 4e-6.
    assert moves.tolist()[0] == pytest.approx([math.log(factor)] * 3, abs=5e-6 if dtype == torch.float32 else 1e-11)


def test_noise_follows_the_covariance_and_falls_with_opacity():
    generator = torch.Generator().manual_seed(SEED)
    scales = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    quats = torch.randn(6, 4, generator=generator, dtype=torch.float64)
    opacities = torch.logit(torch.tensor([1e-6, 0.005, 0.02, 0.05, 0.5, 0.999], dtype=torch.float64))[:, None]
    torch.manual_seed(SEED)
    moves = position_noise(scales, quats, opacities)
    torch.manual_seed(SEED)
    normal = torch.randn(6, 3, 1, dtype=torch.float64)[..., 0]
    for i, matrix in enumerate(rotation_matrices(quats)):
        covariance = matrix @ torch.diag((2 * scales[i]).exp()) @ matrix.T
        share = 1 / (1 + math.exp(100 * (float(torch.sigmoid(opacities[i])) - 0.005)))
        torch.testing.assert_close(moves[i], share * covariance @ normal[i], rtol=1e-9, atol=1e-60)
    torch.manual_seed(SEED)
    single = position_noise(scales.float(), quats.float(), opacities.float())
    assert single.dtype == torch.float32 and single.isfinite().all()


def test_the_picture_hardly_changes_where_gaussians_move_to_others():
    """A transparent Gaussian is moved, one is added; both to the only opaque ones."""
    params = torch.nn.ParameterDict(
        {
            "means": torch.nn.Parameter(torch.tensor([[0.0, 0, 0], [5.0, 0, 0], [1.0, 0, 0]])),
            "scales": torch.nn.Parameter(torch.zeros(3, 3)),
            "quats": torch.nn.Parameter(torch.ones(3, 4)),
            "opacities": torch.nn.Parameter(torch.tensor([[3.0], [-9.0], [-20.0]])),
        }
    )
    optimizers = {name: torch.optim.Adam([value], lr=0.0) for name, value in params.items()}
    strategy = CappedStrategy(most=4, first_step=0, full_from=10, last_step=100, every=5)
    seen, nothing = ({"radii": torch.tensor([[[size, size]]])} for size in (3, 0))
    torch.manual_seed(SEED)
    for step, info in ((4, seen), (5, nothing)):
        strategy.step_post_backward(params, optimizers, {}, step, info)
        assert len(params["means"]) == 3, "neither between densifications, nor in a step that was skipped"
    strategy.step_post_backward(params, optimizers, {}, 5, seen)
    assert params["means"].tolist() == [[0.0, 0, 0]] * 4, "all are where the only opaque one is"
    left = (1 - torch.sigmoid(params["opacities"].detach())).prod()
    assert float(left) == pytest.approx(1 - float(torch.sigmoid(torch.tensor(3.0))), rel=1e-5)
    strategy.step_post_backward(params, optimizers, {}, 95, seen)
    strategy.step_post_backward(params, optimizers, {}, 100, seen)
    assert len(params["means"]) == 4


@pytest.fixture
def capped_config(wall_scene, wall_config):
    def config_of(folder, steps: int, most: int, seeds: int = 300):
        config = wall_config(wall_scene, folder, steps)
        config.pipeline.model.max_gs_num = most
        config.pipeline.datamanager.dataparser.num_seed_points = seeds
        return config

    return config_of


@pytest.mark.parametrize("most", [60, 1000], ids=["fewer than seeds", "more than seeds"])
def test_a_training_ends_with_exactly_so_many_gaussians(capped_config, run_training, tmp_path, most):
    trainer, losses = run_training(capped_config(tmp_path, 60, most))
    model = trainer.pipeline.model
    assert model.num_points == most
    assert sum(losses[-5:]) < 0.6 * sum(losses[:5])
    assert all(value.isfinite().all() for value in model.gauss_params.values())
    for name, optimizer in trainer.optimizers.optimizers.items():
        if name in model.gauss_params:
            assert optimizer.param_groups[0]["params"][0] is model.gauss_params[name]
            assert optimizer.state[model.gauss_params[name]]["exp_avg"].shape == model.gauss_params[name].shape


def test_a_capped_training_is_the_same_on_two_threads(capped_config, run_training, tmp_path):
    means = []
    for threads in (1, 2):
        config = capped_config(tmp_path / str(threads), 22, 400)
        config.threads = threads
        means.append(run_training(config)[0].pipeline.model.means)
    assert torch.equal(*means)
    rest = capped_config(tmp_path / "rest", 3, 399)
    rest.load_dir = config.get_checkpoint_dir()
    with pytest.raises(PointSplatError, match="has 400 Gaussians; expected at most 399, as --pipeline"):
        run_training(rest)


def test_random_points_of_a_cap_are_uniform_in_contracted_space():
    torch.manual_seed(SEED)
    points, colors = random_seeds_near_cameras(SplatfactoCpuModelConfig(num_random=40_000, random_scale=10.0))
    distances = points.norm(dim=1)
    assert points.shape == (40_000, 3) and colors.shape == (0, 3)
    assert float(distances.max()) <= 5.0 * (1 + 1e-5) and float(points.mean(0).norm()) < 0.05
    for radius in (0.5, 1.0, 2.0, 4.0):
        contracted = radius if radius <= 1 else 2 - 1 / radius
        share = float((distances < radius).float().mean())
        assert share == pytest.approx((contracted / 1.8) ** 3, abs=0.0125)  # five standard deviations
    near, _ = random_seeds_near_cameras(SplatfactoCpuModelConfig(num_random=1000, random_scale=0.5))
    assert float(near.norm(dim=1).max()) <= 1 + 1e-5


def test_a_short_training_densifies_by_gradient_alone():
    """Rates begin (30,000 / steps) ** 0.5 times higher, and the gradient of densification rises by the root of that."""
    config = splatfacto_cpu_config()
    config.max_num_iterations = 1875
    short = fitted_schedules(config).pipeline.model
    assert short.densification(10).refine_scale2d_stop_iter == 0
    assert short.densify_grad_thresh == pytest.approx(2 * SplatfactoCpuModelConfig().densify_grad_thresh)
    assert fitted_schedules(config).optimizers["means"]["scheduler"].first == pytest.approx(4)
    config.pipeline.model.max_gs_num = 50_000
    strategy = fitted_schedules(config).pipeline.model.densification(10)
    assert isinstance(strategy, CappedStrategy) and strategy.most == 50_000
    assert strategy.first_step < strategy.full_from < strategy.last_step < 1875
    config.pipeline.model.stop_screen_size_at = 7
    assert fitted_schedules(config).pipeline.model.stop_screen_size_at == 7
    whole = splatfacto_cpu_config()
    whole.max_num_iterations = 30_000
    assert fitted_schedules(whole).pipeline.model == SplatfactoCpuModelConfig()
    whole.pipeline.model.max_gs_num = 0
    with pytest.raises(PointSplatError, match="max-gs-num 0: expected at least 1"):
        whole.pipeline.model.densification(10)
