"""What several test modules make: scenes, cameras, settings of a training, runs whose data is gone;
and what a file imports."""

import ast
import dataclasses
import itertools
import math
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np
import torch

from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, ViewProvider
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import ImageSize, Views
from pointsplat_ns.system.threads import fixed_threads
from pointsplat_ns.view_sampling.poses import look_at, views_of
from pointsplat_ns.view_sampling.sampler import sample_views

REPOSITORY = Path(__file__).resolve().parents[2]

SHARED_DATA = REPOSITORY.parent / "shared" / "data"
"""Real captures, splats and weights that tests read in place; they skip where it is absent."""

QUICK_START = REPOSITORY / "tests" / "support" / "quick_start"
"""First on the path of programs of nerfstudio that need not list the methods of others."""


def quick_start() -> dict[str, str]:
    """The environment, for programs of nerfstudio that need not list the methods of others."""
    paths = filter(None, (str(QUICK_START), os.environ.get("PYTHONPATH")))
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def imports_of(path: Path) -> set[str]:
    """Every module or name that a file imports, wherever in it."""
    nodes = [*ast.walk(ast.parse(path.read_text("utf-8")))]
    modules = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    froms = (node for node in nodes if isinstance(node, ast.ImportFrom))
    return modules | {f"{node.module}.{alias.name}" for node in froms for alias in node.names}


def same(a: Gaussians, b: Gaussians) -> bool:
    """Whether all parameters of two scenes are equal; -0 equals 0, NaN equals nothing."""
    return all(torch.equal(x, y) for x, y in zip(a.tensors(), b.tensors(), strict=True))


def same_bits(a: Gaussians, b: Gaussians) -> bool:
    """Whether all parameters of two float32 scenes have the same bits."""
    return same(*(scene.map(lambda value: value.view(torch.int32).double()) for scene in (a, b)))


def equal(a: object, b: object) -> bool:
    """Whether nested dictionaries of tensors and other values are equal to the bit."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(equal(a[name], b[name]) for name in a)
    return (
        torch.equal(a, b) if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor) else a == b
    )


def assert_same_on_any_threads(function: Callable[[], Sequence[torch.Tensor]]) -> None:
    """Fail unless the tensors that a function gives have the same bits on one thread, two and
    five."""
    with fixed_threads(1):
        wanted = function()
    for threads in (2, 5):
        with fixed_threads(threads):
            assert all(torch.equal(a, b) for a, b in zip(wanted, function(), strict=True))


def normal_scene(
    n: int = 5, degree: int = 3, seed: int = 0, dtype: torch.dtype = torch.float32
) -> Gaussians:
    """A scene whose every parameter is drawn from the standard normal distribution."""
    generator = torch.Generator().manual_seed(seed)
    shapes = [(n, 3), (n, 3), (n, 4), (n, 1), (n, 3), (n, (degree + 1) ** 2 - 1, 3)]
    return Gaussians(*(torch.randn(shape, generator=generator, dtype=dtype) for shape in shapes))


def splats(
    means: torch.Tensor, scales, logits, colours=0.0, quats=(1.0, 0.0, 0.0, 0.0), degree: int = 0
) -> Gaussians:
    """Gaussians at ``means`` (N, 3), without SH. What else they have is a number or a row for all,
    or one for each."""
    n = len(means)
    scales, logits, colours, quats = (
        torch.as_tensor(value).to(means.dtype).expand(n, width).clone()
        for value, width in ((scales, 3), (logits, 1), (colours, 3), (quats, 4))
    )
    return Gaussians(
        means, scales, quats, logits, colours, means.new_zeros(n, (degree + 1) ** 2 - 1, 3)
    )


def cloud(n: int, seed: int = 0, sh_degree: int = 1) -> Gaussians:
    """``n`` random Gaussians in a unit cube."""
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(n, 3, generator=g)
    shapes = (n, 3), (n, 4), (n, 1), (n, 3), (n, (sh_degree + 1) ** 2 - 1, 3)
    scales, quats, opacities, colours, rest = (torch.randn(shape, generator=g) for shape in shapes)
    return Gaussians(means, 0.5 * scales - 3, quats, opacities, colours, 0.1 * rest)


def ball(
    n: int,
    degree: int = 1,
    seed: int = 0,
    log_size: float = math.log(0.25),
    opacity: float = 2.0,
    bright: float = 0.0,
) -> Gaussians:
    """The inside of a ball of radius 2, covered with coloured blobs."""
    g = torch.Generator().manual_seed(seed)
    shapes = (n, 3), (n, 3), (n, 4), (n, 1), (n, (degree + 1) ** 2 - 1, 3)
    means, scales, quats, opacities, rest = (torch.randn(shape, generator=g) for shape in shapes)
    means = 2 * means / means.norm(dim=1, keepdim=True)
    colours = bright + torch.sin(2 * means)
    return Gaussians(
        means, log_size + 0.2 * scales, quats, opacity + opacities, colours, 0.05 * rest
    )


class Bomb:  # prints when it is unpickled as usual
    def __reduce__(self):
        return (print, ("this must never be printed",))


EYES = torch.tensor([[3.0, 0.0, 0.5], [2.6, 1.5, 0.5], [2.6, -1.5, 0.6]])
"""Where photos of :func:`photographed` were taken."""


def photographed(n: int = 600, degree: int = 3, eyes: torch.Tensor = EYES) -> Gaussians:
    """A ball whose SH were moved along the basis in the directions that eyes see it from, by random
    steps."""
    from pointsplat_ns.rendering.spherical_harmonics import sh_basis

    scene = ball(n, degree)
    generator = torch.Generator().manual_seed(1)
    rest = torch.zeros_like(scene.features_rest)
    for eye in eyes:
        directions = torch.nn.functional.normalize(scene.means - eye, dim=1)
        steps = 0.05 * torch.randn(n, 1, 3, generator=generator)
        rest += steps * sh_basis(directions, degree)[:, 1:, None]
    return scene.replace(features_rest=rest)


def box_room(seed: int, count: int = 900, size: float = 0.15, smooth: bool = False) -> Gaussians:
    """A closed box of opaque Gaussians, 4 x 3 x 2 scene units: free inside, covered all around."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator) * 2 - 1
    rows = torch.arange(count)
    axis = torch.arange(count) % 3
    means[rows, axis] = torch.sign(means[rows, axis])
    phase = torch.randn(3 if smooth else (count, 3), generator=generator)
    colours = torch.sin(2 * means + phase) if smooth else phase
    return splats(
        means * torch.tensor([2.0, 1.5, 1.0]), torch.tensor(size).log(), 4.0, colours, degree=1
    )


def splats_in_view(
    n: int,
    seed: int = 0,
    dtype=torch.float64,
    scale: float = -3.0,
    spread: float = 0.8,
    opacity: float = 1.0,
) -> list[torch.Tensor]:
    """What a rasterizer takes, before the camera of :func:`camera_askew`: means (N, 3), quats (N,
    4), scales (N, 3), opacities (N,) and SH of degree 3 (N, 16, 3)."""
    random = {"generator": torch.Generator().manual_seed(seed), "dtype": torch.float64}
    means = torch.randn(n, 3, **random) * torch.tensor([1.0, 1.0, 0.5]) + torch.tensor(
        [0.0, 0.0, 3.0]
    )
    scales = torch.exp(torch.randn(n, 3, **random) * spread + scale)
    opacities = torch.rand(n, **random) * opacity
    quats = torch.randn(n, 4, **random)
    sh = 0.3 * torch.randn(n, 16, 3, **random)
    return [value.to(dtype) for value in (means, quats, scales, opacities, sh)]


def camera_askew(
    dtype=torch.float64, angle: float = 0.2, cx: float = 20.0, cy: float = 13.0, focal: float = 40.0
):
    """World-to-camera matrix (4, 4), turned by ``angle`` radians and moved a little, and intrinsics
    (3, 3) in pixels whose principal point is not the middle of any usual image."""
    c = math.cos(angle)
    s = math.sin(angle)
    view = [[c, 0, s, 0.1], [0, 1, 0, -0.1], [-s, 0, c, 0.2], [0, 0, 0, 1]]
    K = [[focal, 0, cx], [0, 1.05 * focal, cy], [0, 0, 1]]
    return torch.tensor(view, dtype=dtype), torch.tensor(K, dtype=dtype)


def small_refiner(trained: bool = True, seed: int = 0, **changes):
    """A refiner of two stages in evaluation mode; ``trained`` moves the zero layers, so that
    residuals are not zero."""
    from pointsplat_ns.refinement import Refiner, refiner_preset

    sizes = {
        "strides": (2,),
        "enc_channels": (16, 16),
        "enc_depths": (1, 1),
        "enc_heads": (2, 2),
        "patch": 32,
    }
    sizes |= {"dec_channels": (16,), "dec_depths": (1,), "dec_heads": (2,), "head_width": 16}
    torch.manual_seed(seed)
    refiner = Refiner(refiner_preset("tiny", **sizes | changes)).eval()
    return move_zero_layers(refiner) if trained else refiner


@torch.no_grad()
def move_zero_layers(refiner):
    """The refiner, the last layers of whose heads, zero before training, are now random."""
    for mlp in refiner.heads.mlps.values():
        for value in mlp[-1].parameters():
            value.normal_(std=0.1)
    return refiner


def small_config(data: Path, output_dir: Path, steps: int, **model):
    """The method as registered, at a size for tests; no LPIPS in the loss, so that nothing is
    downloaded."""
    from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config

    config = pointsplat_config()
    config.machine.device_type = "cpu"
    config.output_dir = output_dir
    config.max_num_iterations = steps
    config.experiment_name = "refiner"
    config.rate_factor = 1.0
    config.pipeline.datamanager.data = config.data = data
    for name, value in {
        "size": "tiny",
        "keep": 0.5,
        "by": "paper",
        "lpips_weight": 0.0,
        **model,
    }.items():
        setattr(config.pipeline.model, name, value)
    config.set_timestamp()
    return config


def fast_config(data: Path, output_dir: Path, steps: int = 10, **model):
    """The method at a size for tests, at rates for the few steps that they take."""
    config = small_config(data, output_dir, steps, **model)
    config.rate_factor = 10.0
    return config


def dense_config(data: Path, output_dir: Path, steps: int):
    """The method at a size for tests, which renders a few tiny pictures of scenes without
    photos."""
    config = small_config(data, output_dir, steps, keep=0.4)
    config.steps_per_eval_image = 3
    config.pipeline.datamanager.sampled_poses = 6
    config.pipeline.datamanager.sampled_size = (48, 36)
    return config


def losses_of(trainer) -> list[float]:
    """A list that gets the loss of every step that a trainer of nerfstudio takes from now on."""
    losses = []
    iteration = trainer.train_iteration

    def recorded(step: int):
        result = iteration(step)
        losses.append(result[0].item())
        return result

    trainer.train_iteration = recorded
    return losses


@contextmanager
def views_sampled_once() -> Iterator[None]:
    """Within, trainings do not sample a scene's poses again that they sampled before. That takes
    most of their time."""
    from pointsplat_ns.nerfstudio_plugin.pointsplat import dense_scenes

    known = {}

    def sampled(scene: Gaussians, *arguments: int):
        key = (*arguments, *(value.numpy().tobytes() for value in scene.tensors()))
        if key not in known:
            known[key] = sample_views(scene, *arguments)
        return known[key]

    with mock.patch.object(dense_scenes, "sample_views", sampled):
        yield


def pipeline_of(data: Path, eval_scenes: tuple[str, ...] = (), test_mode: str = "test", **model):
    """The pipeline of :func:`fast_config`, in evaluation mode."""
    config = fast_config(data, Path("unused"), **model)
    config.pipeline.datamanager.eval_scenes = eval_scenes
    return config.pipeline.setup(device="cpu", test_mode=test_mode).eval()


def run_of(folder: Path, name: str) -> Path:
    """The one run of a splatfacto-cpu experiment."""
    (path,) = (folder / name / "splatfacto-cpu").iterdir()
    return path


def write_run(folder: Path, steps: int, planned: int) -> Path:
    """The folder of a run that took some of the steps that it was to take, with a checkpoint, which
    it gives."""
    checkpoint = folder / "nerfstudio_models" / f"step-{steps - 1:09d}.ckpt"
    checkpoint.parent.mkdir(parents=True)
    torch.save({}, checkpoint)
    (folder / "config.yml").write_text(
        f"!!python/object:a.Trainer\nmax_num_iterations: {planned}\npipeline: "
        "!!python/object:a.Pipeline\n"
        "  datamanager: !!python/object:a.Data {}\n  model: !!python/object:a.Model {}\n"
    )
    return checkpoint


def without_data(runs: Path, folder: Path) -> Path:
    """A copy of runs, whose data is where nobody finds it: below ``gone_from_here``."""
    shutil.copytree(runs, folder)
    for config in folder.rglob("config.yml"):
        config.write_text(config.read_text().replace("- replica", "- gone_from_here"))
    return folder


def noisy_pair(
    *shape: int, dtype: torch.dtype = torch.float32
) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (..., H, W, 3) in [0, 1]: one with noise, and the same without."""
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(*shape, 3, generator=generator, dtype=dtype)
    return (target + 0.1 * torch.randn(*shape, 3, generator=generator, dtype=dtype)).clamp(
        0, 1
    ), target


def decoded(path: Path) -> list[np.ndarray]:
    """The frames (H, W, 3) uint8 of a video."""
    import av
    from av.video.reformatter import ColorRange

    ranges = {
        "src_color_range": ColorRange.MPEG,
        "dst_color_range": ColorRange.JPEG,
    }  # PyAV 16 does not ask
    with av.open(str(path)) as container:
        frames = [frame.reformat(format="rgb24", **ranges) for frame in container.decode(video=0)]
    return [frame.to_ndarray() for frame in frames]


class FewViews(ViewProvider):
    """Fresh views of 48 x 36 pixels."""

    def sampled(self, seed: int = 0, count: int = VIEW_COUNTS.stepped, drawn_side: int = 320):
        for number in itertools.count(1):
            yield from sample_views(self._scene, 8, 48, 36, seed=number)

    others = sampled


def in_pictures(views: Views, points: torch.Tensor, min_depth: float = 0.0) -> torch.Tensor:
    """Which points (N, 3) beyond a depth are in the pictures of C views, (C, N) bool."""
    at = views.viewmats[:, :3, :3].to(points) @ points.T + views.viewmats[:, :3, 3:].to(points)
    x, y, depth = (views.Ks.to(points) @ at).unbind(
        1
    )  # x and y in pixels, times the depth: nothing is divided by it
    within = (x > 0) & (x < views.width * depth) & (y > 0) & (y < views.height * depth)
    return (depth > min_depth) & within


def several_sizes(views: Views) -> Views:
    """The same cameras, every third one held upright, and every fourth one with half as many
    pixels a side: photos of two devices, one of them turned."""
    images = []
    Ks = views.Ks.clone()
    for index in range(len(views)):
        size = views.width, views.height
        if index % 3 == 2:
            size = size[::-1]
            Ks[index, :2, 2] = Ks[index, :2, 2].flip(0)
        if index % 4 == 3:
            size = size[0] // 2, size[1] // 2
            Ks[index, :2] *= 0.5
        images.append(ImageSize(*size))
    return dataclasses.replace(views, Ks=Ks, images=images)


def views_from_within(
    centre: tuple[float, float, float], count: int, width: int, height: int
) -> Views:
    """Cameras up to half a unit from a place, which look to all sides, about level."""
    generator = torch.Generator().manual_seed(11)
    eyes = torch.tensor(centre) + torch.rand(count, 3, generator=generator) - 0.5
    turns = 2 * math.pi * torch.arange(count) / count
    ahead = torch.stack(
        [turns.cos(), turns.sin(), 0.4 * torch.rand(count, generator=generator) - 0.3], dim=1
    )
    return views_of(look_at(eyes.double(), (eyes + ahead).double()), width, height, 5.0)
