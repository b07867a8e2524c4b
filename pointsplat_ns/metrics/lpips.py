"""LPIPS: perceptual distance of images (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep
Features as a Perceptual Metric").

The convolutions are those of torchvision's AlexNet or VGG16; the linear weights on top are those that
come with torchmetrics. Where the convolutions' weights cannot be had, :func:`load_lpips` says why, and
everything else goes on without LPIPS.
"""

from __future__ import annotations

import importlib.util
import os
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.metrics import ImageError, as_nchw, per_image

Net = Literal["alex", "vgg"]

WEIGHTS_VARIABLE = "POINTSPLAT_LPIPS_WEIGHTS"
"""Environment variable: a folder with backbones under one of their usual names, or one file."""

DOWNLOAD_TIMEOUT_S = 15.0
"""Silence of a server after which a download is given up."""

_NORM_EPS = 1e-8
"""Inside the square root of a feature's length, as torchmetrics has it: keeps the gradient finite at 0."""


class LpipsUnavailable(PointSplatError):
    """The weights that LPIPS needs cannot be had; the text says why, in one line."""


@dataclass(frozen=True)
class _Conv:
    """A convolution with ReLU, and what surrounds it."""

    index: int  # in torchvision's ``features``
    shape: tuple[int, int, int]  # out channels, in channels, kernel side
    stride: int = 1
    padding: int = 1
    pool: int = 0  # side of the max-pooling of stride 2 before it; 0 for none
    tap: bool = False  # compared by LPIPS after its ReLU


@dataclass(frozen=True)
class _Architecture:
    convs: tuple[_Conv, ...]
    minimum: int  # image side below which the last feature map is empty
    files: tuple[str, ...]  # usual file names; the last is torchvision's own
    url: str = "https://download.pytorch.org/models/"


_ARCHITECTURES: dict[str, _Architecture] = {
    "alex": _Architecture(
        convs=(
            _Conv(0, (64, 3, 11), stride=4, padding=2, tap=True),
            _Conv(3, (192, 64, 5), padding=2, pool=3, tap=True),
            _Conv(6, (384, 192, 3), pool=3, tap=True),
            _Conv(8, (256, 384, 3), tap=True),
            _Conv(10, (256, 256, 3), tap=True),
        ),
        minimum=31,
        files=("alexnet_features.pth", "alexnet-owt-7be5be79.pth"),
    ),
    "vgg": _Architecture(
        convs=(
            _Conv(0, (64, 3, 3)),
            _Conv(2, (64, 64, 3), tap=True),
            _Conv(5, (128, 64, 3), pool=2),
            _Conv(7, (128, 128, 3), tap=True),
            _Conv(10, (256, 128, 3), pool=2),
            _Conv(12, (256, 256, 3)),
            _Conv(14, (256, 256, 3), tap=True),
            _Conv(17, (512, 256, 3), pool=2),
            _Conv(19, (512, 512, 3)),
            _Conv(21, (512, 512, 3), tap=True),
            _Conv(24, (512, 512, 3), pool=2),
            _Conv(26, (512, 512, 3)),
            _Conv(28, (512, 512, 3), tap=True),
        ),
        minimum=16,
        files=("vgg16_features.pth", "vgg16-397923af.pth"),
    ),
}


class Lpips(nn.Module):
    """The distance itself. Always frozen: its weights are non-persistent buffers, so they follow a
    parent module to its device but are not among its parameters nor in its checkpoints.

    Args:
        net: which backbone.
        backbone: its state dict, with keys ``features.N.weight`` and ``.bias``; others are ignored.
        linear: the state dict of the linear weights, with keys ``linN.model.1.weight`` (1, C, 1, 1).

    Raises:
        LpipsUnavailable: if a tensor is missing or of the wrong shape.
    """

    shift: Tensor
    spread: Tensor

    def __init__(self, net: Net, backbone: Mapping[str, Tensor], linear: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.net = net
        self._architecture = _ARCHITECTURES[net]
        # Mean and standard deviation of ImageNet, in units of [-1, 1], as LPIPS was fitted with.
        self._frozen("shift", torch.tensor([-0.030, -0.088, -0.188]).reshape(1, 3, 1, 1))
        self._frozen("spread", torch.tensor([0.458, 0.448, 0.450]).reshape(1, 3, 1, 1))
        tap = 0
        for conv in self._architecture.convs:
            out, inner, side = conv.shape
            key = f"features.{conv.index}"
            self._frozen(f"weight{conv.index}", _expect(backbone, f"{key}.weight", (out, inner, side, side)))
            self._frozen(f"bias{conv.index}", _expect(backbone, f"{key}.bias", (out,)))
            if conv.tap:
                self._frozen(f"linear{tap}", _expect(linear, f"lin{tap}.model.1.weight", (1, out, 1, 1)))
                tap += 1

    def _frozen(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value.detach().to(torch.float32, copy=True), persistent=False)

    def forward(self, pred: Tensor, target: Tensor) -> Tensor:
        """LPIPS of each image pair.

        Args:
            pred: (H, W, 3) or (B, H, W, 3), in [0, 1]; at least 31 pixels a side for AlexNet, 16 for VGG.
            target: the same shape.

        Returns:
            A scalar, or (B,); 0 for identical images. Differentiable in both.

        Raises:
            ImageError: if the images cannot be compared or are too small for the network.
        """
        a, b = as_nchw(pred, target)
        least = self._architecture.minimum
        if min(a.shape[2:]) < least:
            raise ImageError(
                f"images of {a.shape[3]} x {a.shape[2]} pixels are too small for LPIPS with {self.net}; "
                f"expected at least {least} x {least}"
            )
        total = a.new_zeros(a.shape[0])
        for tap, (fa, fb) in enumerate(zip(self._features(a), self._features(b), strict=True)):
            weight = self.get_buffer(f"linear{tap}").to(fa.dtype)
            total = total + (weight * (fa - fb).square()).sum(dim=1).mean(dim=(1, 2))
        return per_image(total, pred)

    def _features(self, images: Tensor) -> list[Tensor]:
        """Feature maps of images (B, 3, H, W) in [0, 1], each pixel's of length 1 over the channels."""
        x = (2 * images - 1 - self.shift.to(images.dtype)) / self.spread.to(images.dtype)
        taps = []
        for conv in self._architecture.convs:
            if conv.pool:
                x = F.max_pool2d(x, conv.pool, 2)
            weight, bias = (self.get_buffer(f"{part}{conv.index}").to(x.dtype) for part in ("weight", "bias"))
            x = F.relu(F.conv2d(x, weight, bias, conv.stride, conv.padding))
            if conv.tap:
                taps.append(x / torch.sqrt(x.square().sum(dim=1, keepdim=True) + _NORM_EPS))
        return taps


def load_lpips(net: Net = "alex", backbone: Path | str | None = None, download: bool = True) -> Lpips:
    """LPIPS with its weights, on the CPU.

    The backbone comes from the first of these that there is: the file ``backbone``; what the
    environment variable ``POINTSPLAT_LPIPS_WEIGHTS`` names; torch hub's checkpoint cache; torchvision's
    download into that cache. A file may hold the whole network or its convolutions alone, and is
    loaded with ``weights_only=True``.

    Args:
        net: ``"alex"`` (what most papers report) or ``"vgg"`` (what the training loss uses).
        backbone: a local file; if given, nothing else is tried.
        download: whether the network may be used.

    Raises:
        LpipsUnavailable: if no weights can be had; one line with the reason.

    Example:
        >>> load_lpips("alex", backbone="alexnet_features.pth")  # doctest: +SKIP
    """
    if net not in _ARCHITECTURES:
        raise LpipsUnavailable(f"no LPIPS network is called {net!r}; expected one of {', '.join(_ARCHITECTURES)}")
    linear = _load(_linear_file(net))
    if backbone is not None:
        return _build(net, Path(backbone), linear)
    named = os.environ.get(WEIGHTS_VARIABLE)
    if named:
        place = Path(named).expanduser()
        if not place.exists():
            raise LpipsUnavailable(f"{place}: no such file or folder, though {WEIGHTS_VARIABLE} names it")
        if place.is_dir():
            found = next((place / name for name in _ARCHITECTURES[net].files if (place / name).is_file()), None)
            if found is not None:
                return _build(net, found, linear)
        elif not any(place.name in other.files for key, other in _ARCHITECTURES.items() if key != net):
            return _build(net, place, linear)  # but for a file that its name says is the other network's
    cached = Path(torch.hub.get_dir()) / "checkpoints" / _ARCHITECTURES[net].files[-1]
    if not cached.is_file():
        _download(net, cached, download)
    return _build(net, cached, linear)


def _build(net: Net, path: Path, linear: Mapping[str, Tensor]) -> Lpips:
    state = _load(path)
    try:
        return Lpips(net, state, linear)
    except LpipsUnavailable as error:
        raise LpipsUnavailable(f"{path}: not the weights of LPIPS's {net} backbone; {error}") from error


def _load(path: Path) -> Mapping[str, Tensor]:
    if not path.is_file():
        raise LpipsUnavailable(f"{path}: no such file; expected weights for LPIPS")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged pickle can raise nearly anything
        raise LpipsUnavailable(f"{path}: truncated or not a state dict ({type(error).__name__})") from error
    if not isinstance(state, Mapping):
        raise LpipsUnavailable(f"{path}: holds a {type(state).__name__}; expected a state dict")
    return state


def _expect(state: Mapping[str, Tensor], key: str, shape: tuple[int, ...]) -> Tensor:
    value = state.get(key)
    if not isinstance(value, Tensor):
        raise LpipsUnavailable(f"lacks {key!r} (found {', '.join(map(str, list(state)[:3])) or 'no keys'})")
    if tuple(value.shape) != shape:
        raise LpipsUnavailable(f"{key!r} has shape {tuple(value.shape)}, expected {shape}")
    return value


def _linear_file(net: Net) -> Path:
    """The linear weights inside the installed torchmetrics, found without the cost of importing it."""
    spec = importlib.util.find_spec("torchmetrics")
    if spec is None or not spec.submodule_search_locations:
        raise LpipsUnavailable("torchmetrics, which carries LPIPS's linear weights, is not installed")
    return Path(spec.submodule_search_locations[0]) / "functional" / "image" / "lpips_models" / f"{net}.pth"


def _download(net: Net, target: Path, allowed: bool) -> None:
    """torchvision's download into torch hub's cache; whole and of the right hash, or not at all."""
    remedy = f"set {WEIGHTS_VARIABLE} to a folder with {' or '.join(_ARCHITECTURES[net].files)}"
    if not allowed:
        raise LpipsUnavailable(f"{target}: LPIPS's {net} backbone is not there; {remedy}")
    timeout = socket.getdefaulttimeout()
    socket.setdefaulttimeout(DOWNLOAD_TIMEOUT_S)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(
            _ARCHITECTURES[net].url + target.name, str(target), target.stem.split("-")[-1], progress=False
        )
    except Exception as error:  # no route, no name, a proxy's page, a full disk: all mean no LPIPS
        reason = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        why = (str(reason).splitlines() or [type(error).__name__])[0][:100]
        raise LpipsUnavailable(f"LPIPS's {net} backbone cannot be downloaded ({why}); {remedy}") from error
    finally:
        socket.setdefaulttimeout(timeout)
