"""Images as files and as numbers."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.io.files import replacing


def in_unit_range(image: Tensor) -> Tensor:
    """An image of any shape in [0, 1]: bytes count in 255ths, floats stay."""
    return image.float() / 255 if image.dtype == torch.uint8 else image


def write_picture(picture: Tensor, path: Path) -> None:
    """Write an image (H, W, 3), clamped to [0, 1], as a PNG; as a JPEG if the path ends in ``.jpg``. Raises SceneError
    if it cannot be written."""
    from PIL import Image

    image = Image.fromarray((255 * picture.clamp(0, 1)).round().to(torch.uint8).cpu().numpy())
    with replacing(path) as part:
        if path.suffix == ".jpg":
            image.save(part, format="JPEG", quality=90)
        else:
            image.save(part, format="PNG")
