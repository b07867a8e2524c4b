"""The lab's own recomputation of scores and encoder, against the package."""

import numpy as np

import pointsplat_ns as ps
from lab import independent
from making import ball


def test_the_package_agrees_with_a_recomputation_of_its_own(tmp_path, capsys):
    ps.save(ball(300, 3), tmp_path / "room.ply")
    lines = independent.main(tmp_path / "room.ply", views=3, width=48)
    assert "dual-branch encoder's output" in capsys.readouterr().out
    for what, count, median, largest, kept in lines:
        # 1e-9: some thousand terms in float64, in another order; determinants have condition numbers up to 1e8
        assert float(median) <= 1e-9 and float(largest) <= (1e-5 if "where determined" in what else 1e-8), what
        assert kept in ("-", "100, 100, 100"), what
        assert int(count.replace(",", "")) >= (50 if "where determined" in what else 30), what


def test_the_recomputation_notices_another_definition(monkeypatch, tmp_path):
    ps.save(ball(300, 3), tmp_path / "room.ply")
    mine = independent.read_ply(tmp_path / "room.ply")
    by_scales = independent.pup_hessians
    monkeypatch.setattr(  # by standard deviations, as the package had it once
        independent, "pup_hessians", lambda scene, cameras: by_deviations(by_scales(scene, cameras), scene)
    )
    lines = independent.main(tmp_path / "room.ply", views=3, width=48)
    [score] = [line for line in lines if line[0].startswith("PUP-3DGS's score")]
    assert float(score[2]) > 0.01 and score[4] != "100, 100, 100" and len(mine.means) == 300


def by_deviations(blocks: np.ndarray, scene: independent.Splats) -> np.ndarray:
    factors = np.concatenate([np.ones_like(scene.means), np.exp(-scene.log_scales)], axis=1)
    return blocks * factors[:, :, None] * factors[:, None]
