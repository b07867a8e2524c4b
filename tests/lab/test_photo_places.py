"""The map of what explains a scene's SH."""

import torch

from lab.training import photo_places
from making import EYES, photographed
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.views import Views


def test_the_table_and_the_picture_show_that_a_scene_tells(monkeypatch, capsys, tmp_path):
    viewmats = look_at(EYES.double(), torch.zeros(3, 3, dtype=torch.float64))
    K = torch.tensor([[30.0, 0, 24], [0, 30, 18], [0, 0, 1]]).double().repeat(3, 1, 1)
    monkeypatch.setattr(photo_places.ps, "load", lambda run: photographed())
    monkeypatch.setattr(photo_places, "dataset_views", lambda run, split: Views(viewmats, K, 48, 36, torch.zeros(3)))
    monkeypatch.setattr(photo_places, "name_of", lambda run: "ball")
    monkeypatch.setattr(photo_places, "CELLS", 12)
    photo_places.main((tmp_path,), picture=tmp_path / "map.png")
    row = [cell.strip() for cell in capsys.readouterr().out.splitlines()[2].strip("|").split("|")]
    assert row[0] == "ball" and float(row[1]) > 2
    assert float(row[2].rstrip("%")) < 0.7 * float(row[3].rstrip("%"))
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
