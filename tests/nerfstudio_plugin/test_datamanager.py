"""nerfstudio's datamanager with photos read when they are due."""

from types import SimpleNamespace

import cv2
import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.scene_box import SceneBox

from pointsplat_ns.nerfstudio_plugin.datamanager import LazyImageDatamanagerConfig
from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig


def datamanagers(wall_scene, **settings):
    parser = ReplicaDataParserConfig(data=wall_scene, load_seed_points=False, eval_every=3)
    lazy = LazyImageDatamanagerConfig(dataparser=parser, **settings).setup(device="cpu")
    stock = FullImageDatamanagerConfig(dataparser=parser, cache_images_type="uint8").setup(device="cpu")
    return lazy, stock


def test_datamanager_gives_what_nerfstudios_gives_in_its_order(wall_scene):
    lazy, stock = datamanagers(wall_scene, cache_gigabytes=3e-5)  # room for three photos
    for step in range(2 * len(lazy.train_dataset) + 1):
        (camera, data), (other, expected) = lazy.next_train(step), stock.next_train(step)
        assert data["image_idx"] == expected["image_idx"] == camera.metadata["cam_idx"]
        assert torch.equal(data["image"], expected["image"])
        assert torch.equal(camera.camera_to_worlds, other.camera_to_worlds)
        assert torch.equal(camera.get_intrinsics_matrices(), other.get_intrinsics_matrices())
    assert lazy.frame_cache.num_bytes <= 3e4
    assert lazy.get_train_rays_per_batch() == stock.get_train_rays_per_batch()
    ours, theirs = list(lazy.fixed_indices_eval_dataloader), list(stock.fixed_indices_eval_dataloader)
    assert len(ours) == len(theirs) == len(lazy.fixed_indices_eval_dataloader) > 1
    for (camera, data), (other, expected) in zip(ours, theirs, strict=True):
        assert torch.equal(data["image"], expected["image"])
        assert torch.equal(camera.camera_to_worlds, other.camera_to_worlds)
    seen = [lazy.next_eval(step)[1]["image_idx"] for step in range(len(ours))]
    assert sorted(seen) == list(range(len(ours)))
    assert [d["image_idx"] for d in lazy.cached_train] == list(range(len(lazy.train_dataset)))
    assert torch.equal(lazy.cached_eval[1]["image"], theirs[1][1]["image"])


def test_more_than_500_photos_need_neither_pinned_memory_nor_room(tmp_path):
    photo = tmp_path / "photo.png"
    cv2.imwrite(str(photo), np.full((30, 40, 3), 127, np.uint8))
    cameras = Cameras(torch.eye(4)[None, :3].repeat(501, 1, 1), 35.0, 36.0, 20.5, 14.0, 40, 30)
    outputs = DataparserOutputs(
        image_filenames=[photo] * 501, cameras=cameras, scene_box=SceneBox(aabb=torch.zeros(2, 3))
    )

    parser = SimpleNamespace(includes_time=False, get_dataparser_outputs=lambda split: outputs)
    dataparser = SimpleNamespace(data=tmp_path, setup=lambda: parser)
    manager = LazyImageDatamanagerConfig(dataparser=dataparser, cache_gigabytes=1e-5).setup(device="cpu")
    indices = [manager.next_train(step)[1]["image_idx"] for step in range(6)]
    assert len(set(indices)) == 6 and manager.frame_cache.num_bytes <= 1e4
