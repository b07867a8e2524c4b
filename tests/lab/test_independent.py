"""The lab's own recomputation of scores and encoder, against the package."""

import pointsplat_ns as ps
from lab import independent
from making import ball


def test_the_package_agrees_with_a_recomputation_of_its_own(tmp_path, capsys):
    ps.save(ball(300, 3), tmp_path / "room.ply")
    lines = independent.main(tmp_path / "room.ply", views=3, width=48)
    assert "dual-branch encoder's output" in capsys.readouterr().out
    for what, count, median, largest, kept in lines:
        # 1e-9: some thousand terms in float64, in another order; determinants have condition
        # numbers up to 1e8
        assert float(median) <= 1e-9 and float(largest) <= (
            1e-5 if "where determined" in what else 1e-8
        ), what
        assert kept in ("-", "100, 100, 100"), what
        assert int(count.replace(",", "")) >= (50 if "where determined" in what else 30), what
