"""Training steps of a refiner that cannot be used."""

import math
from collections.abc import Container, Iterator
from contextlib import contextmanager
from unittest import mock


@contextmanager
def broken(kind: str, places: Container[int]) -> Iterator[None]:
    """Within, the loss of the steps at these places is NaN, or finite with a gradient that is not."""
    from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import PointSplatPipeline

    losses_of = PointSplatPipeline.get_train_loss_dict

    def losses(self, step):
        outputs, losses, metrics = losses_of(self, step)
        if self.datamanager.place(step) in places:
            weight = self.model.refiner.heads.mlps["scales"][-1].weight
            # a root's slope at 0, times 0
            losses["l1"] = losses["l1"] + (math.nan if kind == "nan" else 0 * (0 * weight.sum()).sqrt())
            assert losses["l1"].isfinite() == (kind == "gradient")
        return outputs, losses, metrics

    with mock.patch.object(PointSplatPipeline, "get_train_loss_dict", losses):
        yield
