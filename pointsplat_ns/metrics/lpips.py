"""LPIPS: perceptual image distance (Zhang et al. 2018).

Source: "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric". The network is
torchmetrics', with its linear weights, on torchvision's AlexNet or VGG16. If their weights are not
available, :func:`load_lpips` says why, and everything else works without LPIPS.
"""

from __future__ import annotations

import functools
import os
import socket
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.metrics import ImageError, as_nchw, per_image
from pointsplat_ns.system.files import one_line

Net = Literal["alex", "vgg"]

WEIGHTS_VARIABLE = "POINTSPLAT_LPIPS_WEIGHTS"
"""Environment variable: a folder with backbone weights under one of their usual names."""


class LpipsUnavailable(PointSplatError):
    """The weights of LPIPS, or torchvision, are not available; the message gives the reason in one
    line."""


class _Backbone(NamedTuple):
    """A torchvision network that LPIPS uses."""

    minimum: int  # image side below which its last layer is empty
    files: tuple[str, str]  # usual file names; the second is torchvision's own
    digest: str  # SHA-256 of torchvision's file, whose name has the first 8 digits


_BACKBONES = {
    "alex": _Backbone(
        31,
        ("alexnet_features.pth", "alexnet-owt-7be5be79.pth"),
        "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
    ),
    "vgg": _Backbone(
        16,
        ("vgg16_features.pth", "vgg16-397923af.pth"),
        "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
    ),
}


class Lpips(nn.Module):
    """torchmetrics' LPIPS network, without memory for weights until they are loaded."""

    def __init__(self, net: Net) -> None:
        super().__init__()
        try:
            import torchvision  # noqa: F401  # torchmetrics' own error omits the reason
            from torchmetrics.functional.image.lpips import _LPIPS, ScalingLayer
        except (ImportError, RuntimeError) as error:  # not installed, or built for another torch
            raise LpipsUnavailable(
                f"LPIPS needs torchvision, which cannot be imported ({one_line(error)})"
            ) from error
        self.net = net
        with torch.device("meta"):  # no random numbers for weights that are replaced
            self.network = _LPIPS(pretrained=False, net=net, pnet_rand=True)
        with torch.device("cpu"):
            self.network.scaling_layer = ScalingLayer().float()  # constants that no file contains

    def load(self, path: Path) -> Lpips:
        """This network, frozen, with the weights of a backbone's file: the whole backbone or only
        its convolutions. Raises LpipsUnavailable if the file holds other weights."""
        from torchmetrics.functional.image import lpips

        linear = Path(lpips.__file__).with_name("lpips_models") / f"{self.net}.pth"
        weights = torch.load(linear, map_location="cpu", weights_only=True)
        try:
            backbone = torch.load(path, map_location="cpu", weights_only=True)
            # slice2.5.weight is torchvision's features.5.weight
            for name in self.network.net.state_dict():
                weights[f"net.{name}"] = backbone[f"features.{name.partition('.')[2]}"].float()
            self.network.load_state_dict(weights, strict=False, assign=True)
        except Exception as error:  # a damaged pickle can raise nearly anything
            why = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            raise LpipsUnavailable(
                f"{path}: not the weights of LPIPS's {self.net} backbone ({why})"
            ) from error
        return self.requires_grad_(False)

    def forward(self, pred: Tensor, target: Tensor) -> Tensor:
        """LPIPS of each image pair, in float32; arguments, result and errors as for
        :func:`lpips`."""
        a, b = as_nchw(pred, target)
        least = _BACKBONES[self.net].minimum
        if min(a.shape[2:]) < least:
            raise ImageError(
                f"images of {a.shape[3]} x {a.shape[2]} pixels are too small for LPIPS with "
                f"{self.net}; expected at least {least} x {least}"
            )
        return per_image(
            self.network(a.float(), b.float(), normalize=True).flatten().to(pred.dtype), pred
        )


def load_lpips(net: Net = "alex", download: bool = True) -> Lpips:
    """LPIPS with its weights, on the CPU.

    The backbone is searched for in the folder that the environment variable
    ``POINTSPLAT_LPIPS_WEIGHTS`` names, then in torch hub's checkpoint cache; torchvision downloads
    it into that cache. A file may hold the whole network or only its convolutions, and is loaded
    with ``weights_only=True``.

    Args:
        net: ``"alex"`` (in most papers) or ``"vgg"`` (in most losses).
        download: whether to download missing weights.

    Raises:
        LpipsUnavailable: if the weights or torchvision are not available.
    """
    if net not in _BACKBONES:
        raise LpipsUnavailable(
            f"no LPIPS network is called {net!r}; expected one of {', '.join(_BACKBONES)}"
        )
    network = Lpips(net)
    path = _file(net)
    if not path.is_file():
        _download(net, path, download)
    return network.load(path)


def cached_lpips(net: Net, device: torch.device | str) -> Lpips:
    """LPIPS on a device, loaded at the first call and then cached. Arguments and errors are those
    of :func:`load_lpips`. A failed download is not repeated, unless a file appears."""
    path = _file(net) if net in _BACKBONES else Path()
    found = _loaded(net, str(torch.device(device)), path, path.is_file())
    if isinstance(found, str):
        raise LpipsUnavailable(found)
    return found


@functools.lru_cache(maxsize=4)  # 10 MB for alex, 59 MB for vgg
def _loaded(net: Net, device: str, path: Path, there: bool) -> Lpips | str:
    """LPIPS on a device, or why it is unavailable; ``there`` says whether ``path`` exists."""
    try:
        return load_lpips(net).to(device)
    except LpipsUnavailable as error:
        return str(error)


class ReportedLpips:
    """LPIPS for reports: returns None instead of raising if LPIPS is not available. Not a module,
    so that a model's checkpoints do not contain its weights."""

    reason: str | None = None
    """The latest reason for a missing value; None if no value is missing."""

    def __call__(self, pred: Tensor, target: Tensor) -> Tensor | None:
        """LPIPS with AlexNet, as :func:`lpips`; None, with ``reason`` set, if it cannot be
        computed."""
        try:
            return cached_lpips("alex", pred.device)(pred, target)
        except (
            LpipsUnavailable,
            ImageError,
        ) as error:  # no weights, or an image too small for the network
            self.reason = str(error)
            return None


def _file(net: Net) -> Path:
    """The backbone's file: in the folder that the environment variable names, else in torch hub's
    cache, where it may be missing. Raises LpipsUnavailable if the variable does not name a
    folder."""
    files = _BACKBONES[net].files
    if named := os.environ.get(WEIGHTS_VARIABLE):
        folder = Path(named).expanduser()
        if not folder.is_dir():
            raise LpipsUnavailable(f"{folder}: no such folder; {WEIGHTS_VARIABLE} names it")
        for name in files:
            if (folder / name).is_file():
                return folder / name
    return Path(torch.hub.get_dir()) / "checkpoints" / files[-1]


def _download(net: Net, target: Path, allowed: bool) -> None:
    """Download torchvision's file into torch hub's cache, atomically. A file with another SHA-256
    is deleted."""
    remedy = f"set {WEIGHTS_VARIABLE} to a folder with {' or '.join(_BACKBONES[net].files)}"
    if not allowed:
        raise LpipsUnavailable(f"{target}: LPIPS's {net} backbone is missing; {remedy}")
    timeout = socket.getdefaulttimeout()
    socket.setdefaulttimeout(15.0)  # seconds without a response
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        url = f"https://download.pytorch.org/models/{target.name}"
        torch.hub.download_url_to_file(url, str(target), _BACKBONES[net].digest, progress=False)
    except Exception as error:  # no route, no name, a proxy's page, a full disk: all mean no LPIPS
        raise LpipsUnavailable(
            f"LPIPS's {net} backbone cannot be downloaded ({one_line(error)}); {remedy}"
        ) from error
    finally:
        socket.setdefaulttimeout(timeout)


def lpips(pred: Tensor, target: Tensor, net: Literal["alex", "vgg"] = "alex") -> Tensor:
    """LPIPS, the perceptual distance of images (Zhang et al. 2018).

    torchvision downloads the backbone's weights at the first call, unless the environment variable
    ``POINTSPLAT_LPIPS_WEIGHTS`` names a folder with them.

    Args:
        pred: (H, W, 3) or (B, H, W, 3), in [0, 1]; at least 31 pixels a side for "alex", 16 for
            "vgg".
        target: the same shape.
        net: the backbone: "alex" as in most papers, "vgg" as in most losses.

    Returns:
        A scalar, or (B,); 0 for identical images. Differentiable.

    Raises:
        LpipsUnavailable: if the weights are not available; the message gives the reason.
        ImageError: if the images cannot be compared.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> image = ps.render(room, ps.sample_views(room, 1)[0])
        >>> float(ps.lpips(image, image))  # doctest: +SKIP
        0.0
    """
    return cached_lpips(net, pred.device)(pred, target)
