"""Training steps of a refiner that cannot be used."""

import math
from collections.abc import Container, Iterator
from contextlib import contextmanager
from unittest import mock

import torch


@contextmanager
def broken(kind: str, places: Container[int]) -> Iterator[None]:
    """Within, photos are NaN or infinite, or a gradient is NaN with a finite loss."""
    from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManager
    from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import PointSplatPipeline

    next_train, losses_of = ScenesDataManager.next_train, PointSplatPipeline.get_train_loss_dict

    def photos(self, step):
        scene, frames = next_train(self, step)
        if self.place(step) in places and kind != "gradient":
            value = {"nan": math.nan, "infinite": math.inf}[kind]
            frames = [(camera, {**data, "image": torch.full(data["image"].shape, value)}) for camera, data in frames]
        return scene, frames

    def losses(self, step):
        outputs, losses, metrics = losses_of(self, step)
        if self.datamanager.place(step) in places and kind == "gradient":
            weight = self.model.refiner.heads.mlps["scales"][-1].weight
            losses["l1"] = losses["l1"] + 0 * (0 * weight.sum()).sqrt()  # a root's slope at 0, times 0
            assert losses["l1"].isfinite()
        return outputs, losses, metrics

    with (
        mock.patch.object(ScenesDataManager, "next_train", photos),
        mock.patch.object(PointSplatPipeline, "get_train_loss_dict", losses),
    ):
        yield
