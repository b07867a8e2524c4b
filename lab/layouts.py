"""Small copies of the layouts in which ScanNet++ and Replica are distributed, made of two captures:

python -m lab.layouts scannetpp/fox replica/kitchen copies
"""

import json
import shutil
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

from lab.common.printing import start
from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica, read_depth


def main(dslr: tyro.conf.Positional[Path], nice: tyro.conf.Positional[Path], to: tyro.conf.Positional[Path]) -> None:
    """Write folders that ``scannetpp-seeded`` reads, and ``semantic/Sequence_1`` for ``replica-data``, to a new folder,
    of a scene of ScanNet++ (``dslr/``) and one of Replica as NICE-SLAM lays it out."""
    meta = json.loads((dslr / "dslr/nerfstudio/transforms.json").read_text("utf-8"))
    listed = {**meta, "frames": meta["frames"] + meta["test_frames"]}
    del listed["test_frames"]
    lists = {
        part: [each["file_path"] for each in meta[key]] for part, key in (("train", "frames"), ("test", "test_frames"))
    }
    straight = {**meta, "camera_model": "PINHOLE", **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)}
    for name, content, folder, transforms in (
        ("hidden", meta, "dslr/resized_images", "dslr/nerfstudio/transforms.json"),
        ("lists", listed, "dslr/resized_images", "dslr/nerfstudio/transforms.json"),
        ("undistorted", straight, "dslr/undistorted_images", "dslr/nerfstudio/transforms_undistorted.json"),
        ("iphone", meta, "iphone/rgb", "iphone/nerfstudio/transforms.json"),
    ):
        shutil.copytree(dslr / "dslr/resized_images", to / name / folder)
        (to / name / transforms).parent.mkdir()
        (to / name / transforms).write_text(json.dumps(content))
    for file in lists["test"]:
        (to / "hidden/dslr/resized_images" / file).unlink()
    (to / "lists/dslr/train_test_lists.json").write_text(json.dumps(lists))
    replica, sequence = load_replica(nice), to / "semantic/Sequence_1"
    for kind in ("rgb", "depth"):
        (sequence / kind).mkdir(parents=True)
    for number, (photo, depth) in enumerate(zip(replica.photos, replica.depths, strict=True)):
        Image.open(photo).save(sequence / f"rgb/rgb_{number}.png")
        millimetres = np.round(1000 * read_depth(depth, replica.params)).astype(np.uint16)
        Image.fromarray(millimetres).save(sequence / f"depth/depth_{number}.png")
    shutil.copy(nice / "traj.txt", sequence / "traj_w_c.txt")
    camera = json.loads((nice.parent / "cam_params.json").read_text("utf-8"))["camera"]
    (sequence / "cam_params.json").write_text(json.dumps({"camera": camera | {"scale": 1000.0}}))


if __name__ == "__main__":
    start(main)
