"""torch's global settings, which other code of the process may have changed, change no result."""

import dataclasses
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

import pointsplat_ns as ps
from making import box_room, move_zero_layers
from pointsplat_ns.pipeline import repair_budget
from pointsplat_ns.pruning.methods import METHODS
from pointsplat_ns.refinement import Refiner, refiner_preset, save_refiner
from pointsplat_ns.system.threads import fixed_threads

pytestmark = pytest.mark.usefixtures("quick")


@contextmanager
def all_settings():
    """Within, numbers without a type are float64, tensors without a device are made on "meta",
    where they have no numbers, and torch refuses operations that may give other bits, fills memory
    before it is written, and keeps no graph."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    torch.use_deterministic_algorithms(True)
    try:
        with torch.inference_mode():
            yield
    finally:
        torch.set_default_dtype(before)
        torch.set_default_device(None)
        torch.use_deterministic_algorithms(False)


def plain(value: Any) -> Any:
    """Lists, numbers and bytes in place of scenes, views and tensors."""
    if isinstance(value, torch.Tensor):
        return str(value.dtype), str(value.device), value.tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, (tuple, list)) else value


def results_of(scene: Path, folder: Path) -> dict[str, Any]:
    room = ps.load(scene)
    views = ps.sample_views(room, 3, width=48, height=36)
    image = ps.render(room, views[0])
    other = ps.render(room[:100], views[0])
    found: dict[str, Any] = {"views": views, "image": image}
    found |= {"psnr": ps.psnr(image, other), "ssim": ps.ssim(image, other)}
    for by, method in METHODS.items():
        found[f"pruned by {by}"] = ps.prune(
            room, 0.3, by=by, views=views if method.needs_views else None
        )
    found["cleaned and pruned"] = ps.prune(room, 0.3, sh="auto", clean=True, views=views)
    compacted = ps.compact(room, 0.3, views=views)
    repaired = compacted.repaired
    assert repaired is not None
    found["compacted"] = [compacted.scene, compacted.psnr, repaired.scene]
    refiner = ps.load_refiner(folder.parent / "refiner.safetensors")
    found["refined"] = ps.refine(found["pruned by paper"], refiner)
    levels = ps.lod(room, ["50%", 60], views=views, folder=folder / "levels")
    found["levels"] = [level.scene for level in levels]
    for suffix in (".ply", ".spz", ".sog", ".splat"):
        ps.save(room, folder / f"room{suffix}")
        found[suffix] = ps.load(folder / f"room{suffix}")
    found["info"] = ps.info(scene)
    ps.write_page(room, folder / "room.html", views=views)
    files = {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }
    return {name: plain(value) for name, value in found.items()} | files


@fixed_threads(
    1
)  # a network's products depend on their number, which other programs on the machine would change
def test_the_api_gives_the_same_bits_whatever_torchs_settings(tmp_path, monkeypatch):
    ps.save(box_room(0, count=300), tmp_path / "scene.ply")
    torch.manual_seed(0)
    refiner = move_zero_layers(Refiner(refiner_preset("tiny", sh_degree=1)))
    save_refiner(refiner, tmp_path / "refiner.safetensors", {"keep": 0.2})
    monkeypatch.setitem(repair_budget.STEPS, "quick", 4)
    for name in ("usual", "changed"):
        (tmp_path / name).mkdir()
    wanted = results_of(tmp_path / "scene.ply", tmp_path / "usual")
    with all_settings():
        found = results_of(tmp_path / "scene.ply", tmp_path / "changed")
    assert [name for name in {*wanted, *found} if found.get(name) != wanted.get(name)] == []
