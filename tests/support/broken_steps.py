"""Training steps that cannot be used."""

import math
from collections.abc import Container, Iterator
from contextlib import ExitStack, contextmanager
from unittest import mock


@contextmanager
def broken(kind: str, places: Container[int]) -> Iterator[None]:
    """Within, the loss of the steps at these places of a refiner's training, or of these steps of a
    scene's, is NaN, or finite with a gradient that is not."""
    from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import PointSplatPipeline
    from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.trainer import SplatfactoCpuPipeline

    def breaking(losses_of):
        def losses(self, step):
            outputs, losses, metrics = losses_of(self, step)
            of_refiner = isinstance(self, PointSplatPipeline)
            if (self.datamanager.place(step) if of_refiner else step) in places:
                name = "l1" if of_refiner else "main_loss"
                weight = (
                    self.model.refiner.heads.mlps["scales"][-1].weight
                    if of_refiner
                    else self.model.scales
                )
                # a root's slope at 0, times 0
                losses[name] = losses[name] + (
                    math.nan if kind == "nan" else 0 * (0 * weight.sum()).sqrt()
                )
                assert losses[name].isfinite() == (kind == "gradient")
            return outputs, losses, metrics

        return losses

    with ExitStack() as patches:
        for pipeline in (PointSplatPipeline, SplatfactoCpuPipeline):
            losses = breaking(pipeline.get_train_loss_dict)
            patches.enter_context(mock.patch.object(pipeline, "get_train_loss_dict", losses))
        yield
