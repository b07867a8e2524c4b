"""The C++ peer of the benchmark: compiled at first use, absent where there is no compiler."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from pointsplat_ns.rasterizer import constants

CLASSIC_EXTENT = 3.0
"""Standard deviations around a mean that the classic design looks at."""
TIGHT_EXTENT = 0.0
"""Stands for the box around each ellipse on which alpha falls to its threshold."""
EXACT_EXTENT = 3.4
"""Standard deviations beyond which no opacity reaches 1/255: nothing is cut off, for comparing images."""


def load_yardstick():
    """The compiled extension module, or one line that says why there is none."""
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)  # it warns where there is no CUDA
    try:
        from torch.utils.cpp_extension import load

        source = Path(__file__).with_name("yardstick.cpp")
        return load("pointsplat_yardstick", [str(source)], extra_cflags=["-O3", "-march=native"]), ""
    except Exception as error:  # whatever a missing or broken toolchain raises
        lines = [line for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
        return None, f"no C++ peer, its figures are left out: {lines[0][:160]}"


@dataclass
class Yardstick:
    """Draws with the C++ peer, one scene and camera at a time."""

    module: object
    extent: float = CLASSIC_EXTENT
    boxes: bool = False
    """Blend Gaussian by Gaussian over the pixels of its square or box, not pixel by pixel over its tile's list."""
    counts: dict[str, int] = field(default_factory=dict)
    """Of the last call: Gaussians seen, tile pairs, and pairs of Gaussian and pixel looked at and drawn."""

    def __post_init__(self) -> None:
        c = constants
        thresholds = [c.ALPHA_MIN, c.ALPHA_MAX, c.TRANSMITTANCE_MIN, c.EPS2D, c.FRUSTUM_MARGIN, 0.01, self.extent]
        self._peer = self.module.Yardstick(thresholds, self.boxes)

    def forward(
        self,
        scene: list[Tensor],  # means, quats, scales, opacities, SH of degree 3
        viewmat: Tensor,  # [4, 4]
        K: Tensor,  # [3, 3]
        width: int,
        height: int,
        keep: bool,
    ) -> tuple[Tensor, Tensor]:
        """Image over black (H, W, 3) and remaining transmittance (H, W, 1); ``keep`` what backward needs."""
        tensors = [t.detach().float().contiguous() for t in (*scene, viewmat, K)]
        image, through = self._peer.forward(*tensors, width, height, keep)
        self._note()
        return image, through

    def backward(self, grad_image: Tensor, grad_through: Tensor) -> list[Tensor]:
        """Gradients of means, quats, scales, opacities and SH."""
        grads = self._peer.backward(grad_image.contiguous(), grad_through.contiguous())
        self._note()
        return grads

    def _note(self) -> None:
        names = ("visible", "tile pairs", "looked at", "drawn")
        self.counts = dict(zip(names, self._peer.counts(), strict=True))
