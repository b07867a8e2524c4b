"""Poses of training photos as a training corrected them.

nerfstudio's camera optimizer learns a small motion for each training photo. A scene fits its photos in the corrected
poses alone. Held-out photos have no correction.
"""

from __future__ import annotations

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from torch import Tensor

from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.io.inert_yaml import Tagged
from pointsplat_ns.io.runs import Run
from pointsplat_ns.io.splatfacto import read_photo_fit


def corrected_poses(run: Run, poses: Tensor) -> Tensor:
    """Poses of a run's training photos with the corrections in its checkpoint, as nerfstudio's model applies them.

    Args:
        run: a Splatfacto run.
        poses: (C, 3, 4) camera to world, OpenGL axes, in the order of the training split.

    Returns:
        (C, 3, 4); ``poses`` itself if the training corrected none.

    Raises:
        SceneError: if the checkpoint is not usable, or the run does not say how it corrects poses.
        DataError: if the dataset has another number of training photos than were corrected.
    """
    adjustments = read_photo_fit(run.checkpoint).adjustments
    if adjustments is None:
        return poses
    if len(adjustments) != len(poses):
        raise DataError(
            f"{run.data}: {len(poses)} training photos, but {run.checkpoint} corrects the poses of "
            f"{len(adjustments)}; put back the data as it was"
        )
    fields = (settings.get("camera_optimizer") for settings in (run.model_fields, run.datamanager_fields))
    modes = [field.fields.get("mode") for field in fields if isinstance(field, Tagged)]
    mode = next((mode for mode in modes if mode in ("SO3xR3", "SE3")), None)
    if mode is None:
        raise SceneError(
            f"{run.config_path}: its camera optimizer has the mode {next(iter(modes), None)!r}, but {run.checkpoint} "
            "holds corrected poses; expected SO3xR3 or SE3; put back the config.yml of the run"
        )
    optimizer: CameraOptimizer = CameraOptimizerConfig(mode=mode).setup(num_cameras=len(poses), device="cpu")
    optimizer.pose_adjustment.data = adjustments
    with torch.no_grad():
        motions = optimizer.get_correction_matrices().to(poses)
    # Rotations are about the camera's own position, translations in world axes.
    return torch.cat([motions[:, :, :3] @ poses[:, :, :3], poses[:, :, 3:] + motions[:, :, 3:]], dim=2)


def need_photos_as_rendered(run: Run, instead: str) -> None:
    """Raise a DataError, with the advice ``instead``, if the training fitted colours to each of its photos: a bilateral
    grid, or an embedding of appearance. Renders of the scene then do not have the colours of the photos."""
    colors = read_photo_fit(run.checkpoint).colors
    if colors:
        raise DataError(
            f"{run.checkpoint}: holds {colors}, which fits colours to each training photo; renders of the scene do not "
            f"have them, so its training photos cannot be used; {instead}"
        )
