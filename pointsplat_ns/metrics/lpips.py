"""LPIPS: perceptual distance of images (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep
Features as a Perceptual Metric").

The network is torchmetrics', with its linear weights, on torchvision's AlexNet or VGG16. If the weights of these are
not available, :func:`load_lpips` says why, and everything else works without LPIPS.
"""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from cachetools import LRUCache, TTLCache
from torch import Tensor, nn

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.metrics import ImageError, as_nchw, per_image

Net = Literal["alex", "vgg"]

WEIGHTS_VARIABLE = "POINTSPLAT_LPIPS_WEIGHTS"
"""Environment variable: a folder with backbones under one of their usual names, or one file."""


class LpipsUnavailable(PointSplatError):
    """The weights of LPIPS, or torchvision, are not available; the message says why, in one line."""


class _Backbone(NamedTuple):
    """A torchvision network that LPIPS uses."""

    minimum: int  # image side below which its last layer is empty
    files: tuple[str, str]  # usual file names; the second is torchvision's own
    digest: str  # SHA-256 of torchvision's file, of which its name has the first 8 digits


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
    """torchmetrics' LPIPS network, frozen, in float32.

    Args:
        net: which backbone.
        backbone: its state dict, with keys ``features.N.weight`` and ``.bias``; others are ignored.
        linear: the state dict of the linear weights, with keys ``linN.model.1.weight`` (1, C, 1, 1).
    """

    def __init__(self, net: Net, backbone: Mapping[str, Tensor], linear: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.net, self.network = net, empty_network(net)
        weights = {**linear}
        for name, empty in self.network.state_dict().items():
            if name.startswith("net."):  # net.slice2.5.weight is torchvision's features.5.weight
                key, shape = f"features.{name.split('.', 2)[2]}", tuple(empty.shape)
                value = backbone.get(key)
                if not isinstance(value, Tensor) or tuple(value.shape) != shape:
                    found = tuple(value.shape) if isinstance(value, Tensor) else [*backbone][:3]
                    raise LpipsUnavailable(f"expected {key!r} of shape {shape}; found {found}")
                weights[name] = value.to(torch.float32)
        self.network.load_state_dict(weights, strict=False, assign=True)
        self.requires_grad_(False)

    def forward(self, pred: Tensor, target: Tensor) -> Tensor:
        """LPIPS of each image pair, in float32; arguments, result and errors are those of :func:`lpips`."""
        a, b = as_nchw(pred, target)
        least = _BACKBONES[self.net].minimum
        if min(a.shape[2:]) < least:
            raise ImageError(
                f"images of {a.shape[3]} x {a.shape[2]} pixels are too small for LPIPS with {self.net}; "
                f"expected at least {least} x {least}"
            )
        return per_image(self.network(a.float(), b.float(), normalize=True).flatten().to(pred.dtype), pred)


def empty_network(net: Net) -> nn.Module:
    """torchmetrics' network in evaluation mode, without memory for its weights. Raises LpipsUnavailable if torchvision
    is not installed, or was built for another torch."""
    try:
        import torchvision  # noqa: F401  # torchmetrics' own error does not tell why
        from torchmetrics.functional.image.lpips import _LPIPS, ScalingLayer
    except (ImportError, RuntimeError) as error:
        why = str(error).partition("\n")[0]
        raise LpipsUnavailable(f"LPIPS needs torchvision, which cannot be imported ({why})") from error
    with torch.device("meta"):  # no random numbers are drawn for weights that are replaced
        network = _LPIPS(pretrained=False, net=net, pnet_rand=True)
    with torch.device("cpu"):
        network.scaling_layer = ScalingLayer().float()  # constants, which are in no file
    return network


def load_lpips(net: Net = "alex", backbone: Path | str | None = None, download: bool = True) -> Lpips:
    """LPIPS with its weights, on the CPU.

    The backbone comes from the first of these that there is: the file ``backbone``; what the environment variable
    ``POINTSPLAT_LPIPS_WEIGHTS`` names; torch hub's checkpoint cache; torchvision's download into that cache. A file may
    hold the whole network or its convolutions alone, and is loaded with ``weights_only=True``.

    Args:
        net: ``"alex"`` (in most papers) or ``"vgg"`` (in most losses).
        backbone: a local file; if given, nothing else is tried.
        download: whether the network may be used.

    Raises:
        LpipsUnavailable: if the weights are not available, or torchvision is not.

    Example:
        >>> load_lpips("alex", backbone="alexnet_features.pth")  # doctest: +SKIP
    """
    if net not in _BACKBONES:
        raise LpipsUnavailable(f"no LPIPS network is called {net!r}; expected one of {', '.join(_BACKBONES)}")
    empty_network(net)  # before anything is downloaded
    linear = _load(_linear_file(net))
    path = _file(net) if backbone is None else Path(backbone)
    if backbone is None and not path.is_file():
        _download(net, path, download)
    state = _load(path)
    try:
        return Lpips(net, state, linear)
    except LpipsUnavailable as error:
        raise LpipsUnavailable(f"{path}: not the weights of LPIPS's {net} backbone; {error}") from error


def cached_lpips(net: Net, device: torch.device | str) -> Lpips:
    """LPIPS on a device, loaded at the first call and the same object afterwards. Arguments and errors are those of
    :func:`load_lpips`.

    A failed download is not tried again for ten minutes, unless a file is found or the environment variable changes. A
    caller whose result must not change over time, such as a training loss, has to remember a failure itself.
    """
    place = (net, str(torch.device(device)), os.environ.get(WEIGHTS_VARIABLE), torch.hub.get_dir())
    with _cache_lock:
        lpips = _loaded.get(place)
        if lpips is None:
            missing = net in _BACKBONES and not _file(net).is_file()
            if missing and place in _failures:
                raise LpipsUnavailable(_failures[place])
            try:
                lpips = _loaded[place] = load_lpips(net).to(device)
            except LpipsUnavailable as error:
                _failures[place] = str(error)
                raise
        return lpips


class ReportedLpips:
    """LPIPS for reports, which returns None instead of raising if LPIPS is not available. Not a module, so that
    checkpoints of a model do not hold its weights."""

    def __init__(self, net: Net = "alex"):
        self.net = net
        self.reason: str | None = None
        """The latest reason for a missing value; None while none is missing."""

    def __call__(self, pred: Tensor, target: Tensor) -> Tensor | None:
        """LPIPS as :meth:`Lpips.forward` gives it; None, with ``reason`` set, where it cannot be computed."""
        try:
            return cached_lpips(self.net, pred.device)(pred, target)
        except (LpipsUnavailable, ImageError) as error:  # no weights, or an image too small for the network
            self.reason = str(error)
            return None


_loaded: LRUCache[tuple, Lpips] = LRUCache(maxsize=4)  # 10 MB for alex, 59 MB for vgg
_failures: TTLCache[tuple, str] = TTLCache(maxsize=16, ttl=600.0)  # s
_cache_lock = threading.Lock()


def _file(net: Net) -> Path:
    """The backbone's file: what the environment variable names, else torch hub's, which may not be there.
    LpipsUnavailable if the variable names nothing that exists."""
    files = _BACKBONES[net].files
    if named := os.environ.get(WEIGHTS_VARIABLE):
        place = Path(named).expanduser()
        if not place.exists():
            raise LpipsUnavailable(f"{place}: no such file or folder, though {WEIGHTS_VARIABLE} names it")
        if place.is_dir():
            for name in files:
                if (place / name).is_file():
                    return place / name
        elif not any(place.name in other.files for key, other in _BACKBONES.items() if key != net):
            return place  # unless its name is that of the other network's file
    return Path(torch.hub.get_dir()) / "checkpoints" / files[-1]


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


def _linear_file(net: Net) -> Path:
    """The file of linear weights that comes with torchmetrics."""
    from torchmetrics.functional.image import lpips

    return Path(lpips.__file__).with_name("lpips_models") / f"{net}.pth"


def _download(net: Net, target: Path, allowed: bool) -> None:
    """Download torchvision's file into torch hub's cache, atomically. A file with another SHA-256 is not kept."""
    remedy = f"set {WEIGHTS_VARIABLE} to a folder with {' or '.join(_BACKBONES[net].files)}"
    if not allowed:
        raise LpipsUnavailable(f"{target}: LPIPS's {net} backbone is not there; {remedy}")
    timeout = socket.getdefaulttimeout()
    socket.setdefaulttimeout(15.0)  # seconds without an answer
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        url = f"https://download.pytorch.org/models/{target.name}"
        torch.hub.download_url_to_file(url, str(target), _BACKBONES[net].digest, progress=False)
    except Exception as error:  # no route, no name, a proxy's page, a full disk: all mean no LPIPS
        reason = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        why = (str(reason).splitlines() or [type(error).__name__])[0][:100]
        raise LpipsUnavailable(f"LPIPS's {net} backbone cannot be downloaded ({why}); {remedy}") from error
    finally:
        socket.setdefaulttimeout(timeout)


def lpips(pred: Tensor, target: Tensor, net: Literal["alex", "vgg"] = "alex") -> Tensor:
    """LPIPS, the perceptual distance of images (Zhang et al. 2018).

    torchvision downloads the backbone's weights at the first call, unless the environment variable
    ``POINTSPLAT_LPIPS_WEIGHTS`` names a folder or file with them.

    Args:
        pred: (H, W, 3) or (B, H, W, 3), in [0, 1]; at least 31 pixels a side for "alex", 16 for "vgg".
        target: the same shape.
        net: the backbone: "alex" as in most papers, "vgg" as in most losses.

    Returns:
        A scalar, or (B,); 0 for identical images. Differentiable.

    Raises:
        LpipsUnavailable: if the weights are not available; the text tells the reason.
        ImageError: if the images cannot be compared.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> image = ps.render(room, ps.sample_views(room, 1)[0])
        >>> float(ps.lpips(image, image))  # doctest: +SKIP
        0.0
    """
    return cached_lpips(net, pred.device)(pred, target)
