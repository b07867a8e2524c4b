"""Recomputes scores, selection and encoder of a real scene in numpy, and compares them with the
package's.

    python -m lab.independent scenes/rock.ply --views 4 --width 320

All above :func:`main` follows publications and file formats, and shares no code with the package.
Cameras are an input: the package places them. Derivatives are taken by complex steps, pictures are
drawn one Gaussian at a time.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from numpy import ndarray

STEP = 1e-30
"""Imaginary step of a derivative. It is never subtracted from anything, so no digit is lost."""


@dataclass
class Splats:
    """The Gaussians of a 3DGS PLY, as it stores them, in float64."""

    means: ndarray  # (N, 3)
    log_scales: ndarray  # (N, 3)
    quats: ndarray  # (N, 4) wxyz
    logits: ndarray  # (N,)
    sh: ndarray  # (N, K, 3)

    def __getitem__(self, rows: ndarray) -> Splats:
        return Splats(*(value[rows] for value in vars(self).values()))

    @property
    def opacity(self) -> ndarray:
        return 1 / (1 + np.exp(-self.logits))

    @property
    def volume(self) -> ndarray:
        return 4 / 3 * math.pi * np.exp(self.log_scales).prod(axis=1)


class Camera(NamedTuple):
    """A pinhole camera, OpenCV axes: world to camera (4, 4), intrinsics (3, 3), pixels, and a
    colour (3,)."""

    viewmat: ndarray
    K: ndarray
    width: int
    height: int
    background: ndarray


def read_ply(path: Path) -> Splats:
    """A binary PLY of floats, as 3DGS writes it."""
    header, _, data = path.read_bytes().partition(b"end_header\n")
    names = [
        line.split()[2] for line in header.decode().splitlines() if line.startswith("property")
    ]
    rows = np.frombuffer(data, "<f4").reshape(-1, len(names)).astype(float)

    def block(start: str, *ends: object) -> ndarray:
        return rows[:, [names.index(f"{start}{end}") for end in ends]]

    count = sum(name.startswith("f_rest_") for name in names)
    rest = (
        block("f_rest_", *range(count)).reshape(len(rows), 3, count // 3).transpose(0, 2, 1)
    )  # all of red is first
    sh = np.concatenate([block("f_dc_", 0, 1, 2)[:, None], rest], axis=1)
    return Splats(
        block("", *"xyz"),
        block("scale_", 0, 1, 2),
        block("rot_", *range(4)),
        block("opacity", "")[:, 0],
        sh,
    )


def paper_score(scene: Splats, weight: float = 0.3) -> ndarray:
    """PointSplat's eq. 3 (arXiv 2604.09903): weight z(opacity) + (1 - weight) z(volume)."""

    def z(values: ndarray) -> ndarray:
        return (values - values.mean()) / values.std()

    return weight * z(scene.opacity) + (1 - weight) * z(scene.volume)


def highest(scores: ndarray, count: int) -> ndarray:
    """Indices of the highest scores, ascending."""
    return np.sort(np.argsort(-scores, kind="stable")[:count])


def harmonics(unit: ndarray, count: int) -> ndarray:
    """Real spherical harmonics (N, count) of unit vectors, as 3DGS orders and signs them."""
    x, y, z = unit.T
    xx = x * x
    yy = y * y
    zz = z * z
    c1 = math.sqrt(3 / math.pi) / 2
    c2 = math.sqrt(15 / math.pi) / 2
    c3 = math.sqrt(35 / (2 * math.pi)) / 4
    d2 = math.sqrt(5 / math.pi) / 4
    d3 = math.sqrt(21 / (2 * math.pi)) / 4
    e3 = math.sqrt(7 / math.pi) / 4
    first = [np.full_like(x, 0.5 / math.sqrt(math.pi)), -c1 * y, c1 * z, -c1 * x]
    second = [c2 * x * y, -c2 * y * z, d2 * (2 * zz - xx - yy), -c2 * x * z, c2 / 2 * (xx - yy)]
    third = [
        -c3 * y * (3 * xx - yy),
        2 * math.sqrt(105 / math.pi) / 4 * x * y * z,
        -d3 * y * (4 * zz - xx - yy),
    ]
    third += [e3 * z * (2 * zz - 3 * xx - 3 * yy), -d3 * x * (4 * zz - xx - yy)]
    third += [math.sqrt(105 / math.pi) / 4 * z * (xx - yy), -c3 * x * (xx - 3 * yy)]
    return np.stack([*first, *second, *third][:count], axis=1)


def projected(scene: Splats, camera: Camera) -> tuple[ndarray, ndarray, ndarray]:
    """Places (N, 2) in pixels, covariances (N, 2, 2) and colours (N, 3) in a picture (3DGS, EWA
    splatting)."""
    rotation = camera.viewmat[:3, :3]
    shift = camera.viewmat[:3, 3]
    (fx, _, cx), (_, fy, cy), _ = camera.K
    x, y, z = (scene.means @ rotation.T + shift).T

    def inside(
        slope: ndarray, focal: float, centre: float, size: int
    ) -> ndarray:  # 1.3 times the field of view
        low = -(centre + 0.15 * size) / focal
        high = (size - centre + 0.15 * size) / focal
        return np.where(slope.real < low, low, np.where(slope.real > high, high, slope))

    zero = np.zeros_like(z)
    across = inside(x / z, fx, cx, camera.width)
    down = inside(y / z, fy, cy, camera.height)
    jacobian = np.stack(
        [fx / z, zero, -fx * across / z, zero, fy / z, -fy * down / z], axis=1
    ).reshape(-1, 2, 3)
    quats = scene.quats / np.linalg.norm(scene.quats, axis=1, keepdims=True)
    skew = np.cross(np.eye(3), quats[:, None, 1:])
    turn = np.eye(3) + 2 * (quats[:, :1, None] * skew + skew @ skew)
    half = jacobian @ rotation @ (turn * np.exp(scene.log_scales)[:, None])
    away = scene.means + rotation.T @ shift  # from the camera
    unit = away / np.sqrt((away * away).sum(axis=1, keepdims=True))
    color = 0.5 + (harmonics(unit, scene.sh.shape[1])[:, :, None] * scene.sh).sum(axis=1)
    places = np.stack([fx * x / z + cx, fy * y / z + cy], axis=1)
    return (
        places,
        half @ half.transpose(0, 2, 1) + 0.3 * np.eye(2),
        np.where(color.real > 0, color, 0),
    )


class Picture:
    """The Gaussians that a camera sees, from near to far, and the parts of its picture that they
    are drawn on."""

    def __init__(self, scene: Splats, camera: Camera):
        depth = scene.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        rows = np.flatnonzero((depth >= 0.01) & (scene.opacity >= 1 / 255))
        self.ids = rows[np.argsort(depth[rows], kind="stable")]
        self.scene = scene[self.ids]
        self.camera = camera
        self.places, self.covariances, self.colors = projected(self.scene, camera)
        self.opacity = self.scene.opacity
        self.inverses = np.linalg.inv(self.covariances)

    def drawn(self) -> Iterator[tuple[int, tuple[slice, slice], ndarray, ndarray, ndarray]]:
        """Number, part of the picture, offsets of its pixels (h, w, 2), alpha and transmittance in
        front (h, w) of each Gaussian; alpha is 0 where it is not drawn: below 1/255, and from the
        one on that would finish the pixel."""
        size = np.array([self.camera.width, self.camera.height])
        front = np.ones(size[::-1])
        open_ = np.ones(size[::-1], bool)
        reach = (
            np.sqrt(2 * np.log(255 * self.opacity)[:, None] * self.covariances[:, [0, 1], [0, 1]])
            + 1
        )
        low = np.clip(self.places - reach, 0, size).astype(int)
        high = np.clip(self.places + reach + 1, 0, size).astype(int)
        for i in np.flatnonzero((low < high).all(axis=1)):
            part = slice(low[i, 1], high[i, 1]), slice(low[i, 0], high[i, 0])
            rows, columns = np.mgrid[part] + 0.5
            offsets = np.stack([columns - self.places[i, 0], rows - self.places[i, 1]], axis=-1)
            alpha = np.minimum(0.999, self.opacity[i] * gauss(offsets, self.inverses[i]))
            hit = (alpha >= 1 / 255) & open_[part]
            last = hit & (front[part] * (1 - alpha) <= 1e-4)
            open_[part] &= ~last
            alpha = np.where(hit & ~last, alpha, 0.0)
            if alpha.any():
                yield i, part, offsets, alpha, front[part].copy()
                front[part] *= 1 - alpha
        self.left = front


def gauss(offsets: ndarray, inverse: ndarray) -> ndarray:
    """exp(-d^T C^-1 d / 2) of offsets (h, w, 2)."""
    x = offsets[..., 0]
    y = offsets[..., 1]
    return np.exp(
        -0.5 * (inverse[0, 0] * x * x + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y * y)
    )


def lightgaussian_score(scene: Splats, cameras: list[Camera], power: float = 0.1) -> ndarray:
    """LightGaussian's global significance (arXiv 2311.17245, eq. 3 and 4): opacity times
    transmittance, summed over the pixels of all views that a Gaussian hits, times min(V / V90,
    1)^power; V90 is the volume at 90 % of all, largest first."""
    total = np.zeros(len(scene.means))
    for camera in cameras:
        picture = Picture(scene, camera)
        for i, _, _, alpha, front in picture.drawn():
            total[picture.ids[i]] += picture.opacity[i] * front[alpha > 0].sum()
    volume = scene.volume
    return total * np.minimum(volume / np.sort(volume)[::-1][int(0.9 * len(volume))], 1) ** power


def pup_hessians(scene: Splats, cameras: list[Camera]) -> ndarray:
    """Hessians (N, 6, 6) of PUP-3DGS (arXiv 2406.10219, section 3.1): sums over views, pixels and
    channels of the outer product of a channel's gradient by mean and log-scale. The score is the
    logarithm of the determinant."""
    total = np.zeros((len(scene.means), 6, 6))
    for camera in cameras:
        picture = Picture(scene, camera)
        part_of = [moved(picture, axis) for axis in range(6)]
        moves, inverses, colors = (np.stack(values) for values in zip(*part_of, strict=True))
        image = np.zeros((camera.height, camera.width, 3))
        for i, part, _, alpha, front in picture.drawn():
            image[part] += (alpha * front)[..., None] * picture.colors[i]
        behind = image + picture.left[..., None] * camera.background
        for i, part, offsets, alpha, front in picture.drawn():
            behind[part] -= (alpha * front)[..., None] * picture.colors[i]
            by_alpha = front[..., None] * picture.colors[i] - behind[part] / (1 - alpha)[..., None]
            by_alpha[(alpha == 0) | (alpha >= 0.999)] = 0
            shapes = [gauss(offsets - moves[axis, i], inverses[axis, i]).imag for axis in range(6)]
            slopes = picture.opacity[i] * np.stack(shapes) / STEP  # (6, h, w)
            slopes = (
                slopes[..., None] * by_alpha + (alpha * front)[..., None] * colors[:, i, None, None]
            )
            slopes = slopes.reshape(6, -1)
            total[picture.ids[i]] += slopes @ slopes.T
    return total


def moved(picture: Picture, axis: int) -> tuple[ndarray, ndarray, ndarray]:
    """Complex moves of places and complex inverse covariances, for a complex step of all Gaussians
    along one of mean (0 to 2) and log-scale (3 to 5); and the derivatives of their colours."""
    step = 1j * STEP * (np.arange(6) == axis)
    scene = Splats(**vars(picture.scene) | {"means": picture.scene.means + step[:3]})
    scene.log_scales = scene.log_scales + step[3:]
    places, covariances, colors = projected(scene, picture.camera)
    return places - picture.places, np.linalg.inv(covariances), colors.imag / STEP


def log_determinants(blocks: ndarray) -> tuple[ndarray, ndarray]:
    """Logarithms of determinants (N,), and the least eigenvalues (N,) of the blocks with a diagonal
    of ones."""
    diagonal = blocks.diagonal(axis1=1, axis2=2)
    root = np.sqrt(np.where(diagonal > 0, diagonal, 1))
    unit = blocks / root[:, :, None] / root[:, None]
    least = np.where((diagonal > 0).all(axis=1), np.linalg.eigvalsh(unit)[:, 0], 0)
    return np.linalg.slogdet(unit)[1] + 2 * np.log(root).sum(axis=1), least


def read_safetensors(path: Path) -> tuple[dict[str, ndarray], dict]:
    """Tensors in float64 and the network's configuration."""
    data = path.read_bytes()
    start = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:start])
    config = json.loads(header.pop("__metadata__")["config"])
    kinds = {"F32": "<f4", "F16": "<f2", "F64": "<f8", "I64": "<i8"}
    found = {}
    for name, about in header.items():
        first, end = about["data_offsets"]
        values = np.frombuffer(data[start + first : start + end], kinds[about["dtype"]])
        found[name] = values.reshape(about["shape"]).astype(float)
    return found, config


def encoder_inputs(scene: Splats, config: dict) -> dict[str, ndarray]:
    """Inputs of the encoder: places in the unit cube, whose outermost 1 % of places count as
    outliers; unit quaternions of one sign; log-scales and logits brought to order 1; harmonics."""
    ordered = np.sort(scene.means, axis=0)
    n = len(scene.means)
    trim = max(1, math.ceil(0.01 * n)) if n >= 8 else 0
    low = ordered[trim]
    high = ordered[n - 1 - trim]
    reach = 0.5 * (high - low).max()
    low = np.maximum(ordered[0], low - reach)
    high = np.minimum(ordered[-1], high + reach)
    extent = (high - low).max()
    centre, spread, logits = (0, 1, 1) if config.get("raw_inputs") else (-5, 2, 4)
    quats = scene.quats / np.linalg.norm(scene.quats, axis=1, keepdims=True)
    first = np.take_along_axis(quats, (quats != 0).argmax(axis=1)[:, None], axis=1)
    rest = scene.sh[:, 1:].reshape(n, -1).clip(-8, 8)
    return {
        "positions": ((scene.means - (low + high) / 2) / extent).clip(-0.5, 0.5),
        "quats": quats * np.sign(first),
        "scales": ((scene.log_scales - math.log(extent)).clip(-17, 7) - centre) / spread,
        "opacities": scene.logits[:, None].clip(-12, 12) / logits,
        "features_dc": scene.sh[:, 0].clip(-8, 8),
        "features_rest": np.pad(
            rest, ((0, 0), (0, 3 * ((config["sh_degree"] + 1) ** 2 - 1) - rest.shape[1]))
        ),
    }


def encoded(inputs: dict[str, ndarray], tensors: dict[str, ndarray], config: dict) -> ndarray:
    """The dual-branch encoder (PointSplat's eq. 4 to 6): softmax(phi_a + delta) * (phi_p +
    delta)."""

    def layers(branch: str, x: ndarray) -> ndarray:
        for number in range(4):
            name = f"encoder.{branch}.{number}"
            if f"{name}.weight" not in tensors:
                x = np.maximum(x, 0)
            elif tensors[f"{name}.weight"].ndim == 2:
                x = x @ tensors[f"{name}.weight"].T + tensors[f"{name}.bias"]
            else:  # normalised over the scene, or by running averages
                mean = tensors.get(f"{name}.running_mean", x.mean(axis=0))
                x = (x - mean) / np.sqrt(tensors.get(f"{name}.running_var", x.var(axis=0)) + 1e-3)
                x = x * tensors[f"{name}.weight"] + tensors[f"{name}.bias"]
            if number == 2 and branch in ("position", "color"):  # two layers
                return x
        return x

    color = layers("color", inputs["features_rest"])
    delta = layers("position", inputs["positions"])
    gate = (
        layers("appearance", np.hstack([inputs["opacities"], inputs["features_dc"], color])) + delta
    )
    gate = np.exp(gate - gate.max(axis=1, keepdims=True))
    gate /= gate.sum(axis=1, keepdims=True)
    geometry = (
        layers("geometry", np.hstack([inputs["positions"], inputs["quats"], inputs["scales"]]))
        + delta
    )
    return gate * geometry * (geometry.shape[1] if config.get("unit_gate") else 1)


def main(
    scene: tyro.conf.Positional[Path],
    views: int = 4,
    width: int = 320,
    keep: float = 0.1,
    refiner: Path | None = None,
) -> list[list[str]]:
    """Print how far the package's results in float64 are from those recomputed here.

    Args:
        scene: a 3DGS PLY, or anything else that the package reads, which it then writes as PLY.
        views: number of views of the scores, at least 2: one does not tell depth.
        width: of their pictures, pixels; the height is 3/4 of it.
        keep: share of the Gaussians that the encoder gets, selected by the paper's score.
        refiner: weights (.safetensors) with a dual-branch encoder; by default those that ship.
    """
    import torch

    import pointsplat_ns as ps
    from lab.common.printing import markdown
    from pointsplat_ns.pruning import paper, select, view_scores
    from pointsplat_ns.refinement.refiner import gaussian_features
    from pointsplat_ns.refinement.structure import unit_cube
    from pointsplat_ns.refinement.weights import SHIPPED_REFINER, read_refiner

    loaded = ps.load(scene)
    with tempfile.TemporaryDirectory() as folder:
        path = scene if scene.suffix == ".ply" else Path(folder) / "scene.ply"
        if path != scene:
            ps.save(loaded, path)
        mine = read_ply(path)
    theirs = loaded.to(torch.float64)
    looks = ps.sample_views(loaded, views, width, 3 * width // 4)
    viewmats, Ks, background = (
        value.double().numpy() for value in (looks.viewmats, looks.Ks, looks.background)
    )
    cameras = [
        Camera(view, K, looks.width, looks.height, background)
        for view, K in zip(viewmats, Ks, strict=True)
    ]
    lines: list[list[str]] = []

    def compare(what: str, own: ndarray, package: torch.Tensor, ranks: bool = False) -> None:
        off = np.abs(own - package.numpy()) / np.maximum(np.abs(own), 1e-3 * np.abs(own).max())
        theirs = (
            [select(package, round(share * len(own))).numpy() for share in (0.5, 0.3, 0.1)]
            if ranks
            else []
        )
        same = [len(np.intersect1d(highest(own, len(rows)), rows)) / len(rows) for rows in theirs]
        found = ", ".join(f"{100 * share:.5g}" for share in same) or "-"
        lines.append([what, f"{len(own):,}", f"{np.median(off):.0e}", f"{off.max():.0e}", found])

    score = paper_score(mine)
    compare("paper's score, eq. 3", score, paper.paper_score(theirs), ranks=True)
    light = lightgaussian_score(mine, cameras)
    compare(
        "LightGaussian's score", light, view_scores.lightgaussian_score(theirs, looks), ranks=True
    )
    blocks = pup_hessians(mine, cameras)
    compare("PUP-3DGS: Hessians", blocks, view_scores.sensitivity(theirs, looks))
    sensitivities, least = log_determinants(blocks)
    clear = np.flatnonzero(least > 1e-8)
    pup = view_scores.pup_score(theirs, looks)[clear]
    compare("PUP-3DGS's score, where determined", sensitivities[clear], pup, ranks=True)

    weights = refiner or SHIPPED_REFINER
    (tensors, config) = read_safetensors(weights)
    network = read_refiner(weights).double()
    kept = highest(score, round(keep * len(score)))
    small = theirs[torch.from_numpy(kept)]
    settings = network.config
    cube = unit_cube(small.means)
    features = gaussian_features(
        small, cube, settings.num_rest, torch.float64, raw=settings.raw_inputs
    )
    inputs = encoder_inputs(mine[kept], config)
    for name, values in inputs.items():
        compare(f"encoder's input {name}", values, getattr(features, name))
    compare(
        "dual-branch encoder's output",
        encoded(inputs, tensors, config),
        network.encoder(features).detach(),
    )
    heads = (
        "recomputed",
        "number",
        "relative difference: median",
        "largest",
        "% the same of the best 50, 30, 10 %",
    )
    print(markdown(heads, lines))
    return lines


if __name__ == "__main__":
    tyro.cli(main)
