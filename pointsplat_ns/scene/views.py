"""Pinhole cameras."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, overload

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.system.tensors import DOUBLES, FLOATS

RasterizeMode = Literal["classic", "antialiased"]
"""Rasterize mode of a scene's training (nerfstudio's ``rasterize_mode``)."""

NEAR_PLANE = 0.01
"""Near plane of gsplat, scene units."""

EPS2D = 0.3
"""Added to the diagonal of each projected covariance, pixels^2, so that no Gaussian is thinner than
a pixel. As in 3DGS and gsplat."""


@dataclass(frozen=True, eq=False, repr=False)
class View:
    """One pinhole camera with rendering settings: an element of :class:`Views`, which documents its
    attributes.

    Example:
        >>> import pointsplat_ns as ps
        >>> view = ps.sample_views(ps.example_room(), 2)[0]
        >>> view.width, view.height, tuple(view.viewmat.shape)
        (320, 240, (4, 4))
    """

    viewmat: Tensor  # [4, 4] world to camera, OpenCV axes, rigid
    K: Tensor  # [3, 3] intrinsics, pixels
    width: int
    height: int
    background: Tensor  # [3] in [0, 1]
    rasterize_mode: RasterizeMode = "classic"
    near_plane: float = NEAR_PLANE  # scene units
    eps2d: float = EPS2D  # pixels^2

    def __repr__(self) -> str:
        return f"View({self.width} x {self.height} pixels, {self.rasterize_mode})"


class ImageSize(NamedTuple):
    """Size of a view's image."""

    width: int  # pixels
    height: int  # pixels
    eps2d: float = EPS2D  # pixels^2

    def __str__(self) -> str:
        return f"{self.width} x {self.height}"


def sizes_text(sizes: Iterable[ImageSize]) -> str:
    """Image sizes in pixels, without the unit: ``640 x 480``, ``640 x 480 and 480 x 640``, or
    ``640 x 480 and 3 other sizes``."""
    first, *others = dict.fromkeys(map(str, sizes))
    if not others:
        return first
    return f"{first} and {others[0] if len(others) == 1 else f'{len(others)} other sizes'}"


@dataclass(frozen=True, eq=False, repr=False)
class Views:
    """C pinhole cameras, and rendering settings.

    ``views[0]`` and iteration give a :class:`View`; slices, lists of indices, index tensors and
    boolean masks give :class:`Views`.

    Attributes:
        viewmats: (C, 4, 4) world-to-camera, OpenCV axes (x right, y down, z forward); rigid, in
            scene units.
        Ks: (C, 3, 3) intrinsics in pixels; the centre of the first pixel is (0.5, 0.5).
        width: width of every image, pixels; with ``images``, the width of the most common size, and
            of the largest of equally common ones.
        height: height of every image, pixels, as ``width``.
        background: (3,) colour behind the scene, RGB in [0, 1].
        rasterize_mode: "classic" or "antialiased", as in the scene's training.
        near_plane: minimum depth of drawn Gaussians, scene units; default as in gsplat.
        eps2d: added to the diagonal of each projected covariance, pixels^2; default as in 3DGS.
        images: size of each image, C of them, if they differ; then ``width``, ``height`` and
            ``eps2d`` follow from them. None if all images have one size.

    Raises:
        DataError: if a shape does not match the others, or an image has no pixels.

    Example:
        >>> import torch
        >>> import pointsplat_ns as ps
        >>> K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
        >>> poses = torch.eye(4).repeat(3, 1, 1)
        >>> views = ps.Views(poses, K.repeat(3, 1, 1), 64, 48, torch.zeros(3))
        >>> len(views), len(views[1:]), views[0].width
        (3, 2, 64)
    """

    viewmats: Tensor  # [C, 4, 4] world to camera, OpenCV axes, rigid
    Ks: Tensor  # [C, 3, 3] intrinsics, pixels
    width: int
    height: int
    background: Tensor  # [3] in [0, 1]
    rasterize_mode: RasterizeMode = "classic"
    near_plane: float = NEAR_PLANE  # scene units
    eps2d: float = EPS2D  # pixels^2
    images: Sequence[ImageSize] | None = None

    def __post_init__(self) -> None:
        tensors = isinstance(self.viewmats, Tensor) and self.viewmats.dim() > 0
        count = self.viewmats.shape[0] if tensors else 0
        for name, shape in (
            ("viewmats", (count, 4, 4)),
            ("Ks", (count, 3, 3)),
            ("background", (3,)),
        ):
            value = getattr(self, name)
            if not isinstance(value, Tensor):
                raise DataError(
                    f"{name} of the views is a {type(value).__name__}; expected a torch.Tensor"
                )
            found = tuple(value.shape)
            if found != shape:
                raise DataError(f"{name} of the views has shape {found}; expected {shape}")
        if self.images is not None:
            self._set_common_size([ImageSize(*size) for size in self.images])
        for size in self.image_sizes():
            if size.width < 1 or size.height < 1:
                raise DataError(f"views are {size} pixels; expected at least 1 x 1")

    def _set_common_size(self, images: list[ImageSize]) -> None:
        if len(images) != len(self):
            raise DataError(f"{len(images)} image sizes for {len(self)} views; expected one each")
        counts = Counter(images)
        common = (
            max(counts, key=lambda size: (counts[size], size.width * size.height, size))
            if images
            else ImageSize(self.width, self.height, self.eps2d)
        )
        for name, value in zip(ImageSize._fields, common, strict=True):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "images", tuple(images) if len(counts) > 1 else None)

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def __repr__(self) -> str:
        return (
            f"Views({len(self)} of {sizes_text(self.image_sizes())} pixels, {self.rasterize_mode})"
        )

    def image_sizes(self) -> list[ImageSize]:
        """The different sizes of the images, most common first."""
        if self.images is None:
            return [ImageSize(self.width, self.height, self.eps2d)]
        common = ImageSize(self.width, self.height, self.eps2d)
        others = (size for size, _ in Counter(self.images).most_common())
        return [common, *(size for size in others if size != common)]

    def size_of_each(self) -> list[ImageSize]:
        """The image size of each of the C views."""
        if self.images is None:
            return [ImageSize(self.width, self.height, self.eps2d)] * len(self)
        return [*self.images]

    def each_size(self, change: Callable[[Views], Views]) -> Views:
        """The views after a change of their images, which is called for the views of each size.

        Args:
            change: changes intrinsics, image size and ``eps2d`` of views that have one size, and
                keeps their number and order.
        """
        if self.images is None:
            return change(self)
        places: dict[ImageSize, list[int]] = {}
        for place, size in enumerate(self.images):
            places.setdefault(size, []).append(place)
        Ks = self.Ks.clone()
        images = [*self.images]
        for of_size in places.values():
            changed = change(self[of_size])
            Ks[of_size] = changed.Ks
            for place in of_size:
                images[place] = ImageSize(changed.width, changed.height, changed.eps2d)
        return replace(self, Ks=Ks, images=images)

    @overload
    def __getitem__(self, index: int) -> View: ...
    @overload
    def __getitem__(self, index: slice | list[int] | Tensor) -> Views: ...

    def __getitem__(self, index: Any) -> View | Views:
        """One view for an integer; several for a slice, a list or tensor of indices, or a boolean
        mask (C,).

        Raises:
            IndexError: if there is no such view.
        """
        viewmats = self.viewmats[index]
        Ks = self.Ks[index]
        single = viewmats.dim() == 2
        size = ImageSize(self.width, self.height, self.eps2d)
        images = None
        if self.images is not None:
            places = torch.arange(len(self), device="cpu")[
                index.cpu() if isinstance(index, Tensor) else index
            ]
            images = [self.images[place] for place in places.view(-1).tolist()]
            size = images[0] if single else size
        same = {
            "background": self.background,
            "rasterize_mode": self.rasterize_mode,
            "near_plane": self.near_plane,
            **size._asdict(),
        }
        return View(viewmats, Ks, **same) if single else Views(viewmats, Ks, **same, images=images)

    def __iter__(self) -> Iterator[View]:
        return (self[index] for index in range(len(self)))

    def relative_to(self, offset: tuple[float, float, float] | None) -> Views:
        """The views of a scene with positions relative to an offset; computed in float64."""
        if offset is None:
            return self
        viewmats = self.viewmats.double()
        moved = viewmats.clone()
        moved[:, :3, 3] += viewmats[:, :3, :3] @ torch.tensor(offset, **DOUBLES).to(viewmats.device)
        return replace(self, viewmats=moved.to(self.viewmats.dtype))

    def spread(self, count: int) -> Views:
        """At most ``count`` of the views, evenly spaced, with the first and the last."""
        if count >= len(self):
            return self
        return self[spread_indices(len(self), count)]

    def resized(self, max_side: int) -> Views:
        """The views with the longer image side at most ``max_side`` pixels; never enlarges."""
        if self.images is not None:
            return self.each_size(lambda of_size: of_size.resized(max_side))
        factor = max_side / max(self.width, self.height)
        if factor >= 1:
            return self
        width = max(1, round(self.width * factor))
        height = max(1, round(self.height * factor))
        stretch = self.Ks.new_tensor([[width / self.width], [height / self.height], [1.0]])
        return replace(self, Ks=self.Ks * stretch, width=width, height=height)


def spread_indices(length: int, count: int) -> list[int]:
    """At most ``count`` indices below ``length``, evenly spaced, with the first and the last."""
    if count >= length:
        return list(range(length))
    return torch.linspace(0, length - 1, count, **FLOATS).round().long().tolist()
