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


def main(dslr: tyro.conf.Positional[Path], nice: tyro.conf.Positional[Path], to: tyro.conf.Positional[Path]) -> None:
    """Write folders that ``scannetpp-seeded`` reads, and ``semantic/Sequence_1`` for ``replica-data``, to a new folder,
    of a scene of ScanNet++ (``dslr/``) and one of Replica as NICE-SLAM lays it out."""
    meta = json.loads((dslr / "dslr/nerfstudio/transforms.json").read_text("utf-8"))
    train, test, plain = meta["frames"], meta.pop("test_frames"), "nerfstudio/transforms.json"
    lists = {name: [frame["file_path"] for frame in frames] for name, frames in (("train", train), ("test", test))}
    straight = meta | {"test_frames": test, "camera_model": "PINHOLE"} | dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    for name, content, folder, transforms in (
        ("hidden", meta | {"test_frames": test}, "dslr/resized_images", f"dslr/{plain}"),
        ("lists", meta | {"frames": train + test}, "dslr/resized_images", f"dslr/{plain}"),
        ("undistorted", straight, "dslr/undistorted_images", "dslr/nerfstudio/transforms_undistorted.json"),
        ("iphone", meta | {"test_frames": test}, "iphone/rgb", f"iphone/{plain}"),
    ):
        shutil.copytree(dslr / "dslr/resized_images", to / name / folder)
        (to / name / transforms).parent.mkdir()
        (to / name / transforms).write_text(json.dumps(content))
    for file in lists["test"]:
        (to / "hidden/dslr/resized_images" / file).unlink()
    (to / "lists/dslr/train_test_lists.json").write_text(json.dumps(lists))
    camera = json.loads((nice.parent / "cam_params.json").read_text("utf-8"))["camera"]
    sequence = to / "semantic/Sequence_1"
    for kind, names in (("rgb", "frame*"), ("depth", "depth*")):
        (sequence / kind).mkdir(parents=True)
        for number, path in enumerate(sorted((nice / "results").glob(names))):
            values = np.asarray(Image.open(path))
            values = values if kind == "rgb" else (values * (1000 / camera["scale"])).astype(np.uint16)
            Image.fromarray(values).save(sequence / kind / f"{kind}_{number}.png")
    shutil.copy(nice / "traj.txt", sequence / "traj_w_c.txt")
    (sequence / "cam_params.json").write_text(json.dumps({"camera": camera | {"scale": 1000.0}}))


if __name__ == "__main__":
    start(main)
