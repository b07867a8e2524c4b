"""What ``ns-render spiral`` asks of a datamanager."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import torch
from nerfstudio.data.datamanagers.base_datamanager import DataManager, VanillaDataManager
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader

from pointsplat_ns.errors import DataError

if TYPE_CHECKING:
    _Base = DataManager
else:
    _Base = VanillaDataManager


class SpiralSource(_Base):
    """A datamanager around whose first held-out camera ``ns-render spiral`` can draw.

    That command takes nerfstudio's ray-based datamanager and its kin alone, so this is one of them by name. Nothing of
    it is used: what derives from this has datasets and batches of its own.
    """

    device: torch.device | str

    def __init__(self) -> None:
        DataManager.__init__(self)

    @cached_property  # one that the viewer, which reads every property of a datamanager, leaves alone
    def eval_dataloader(self) -> FixedIndicesEvalDataloader:
        """Held-out cameras and photos, one at a time; a DataError if no frame is held out."""
        if not self.eval_dataset:
            raise DataError(
                f"{self.get_datapath()}: no frame is held out, so there is no camera to start from; expected at least "
                "one: change the dataparser's split"
            )
        return FixedIndicesEvalDataloader(input_dataset=self.eval_dataset, device=self.device, num_workers=0)
