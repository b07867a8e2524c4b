"""lab/judge/cleaning.py measures what held-out photos lose and gain without floaters."""

from lab.judge import cleaning
from making import run_of


def test_each_strength_is_measured_in_held_out_photos(trained_walls, capsys):
    cleaning.main([run_of(trained_walls, "wall-a")], strengths=(0.0, 1.0), photos=2, side=32)
    lines = [line.split("│")[1:-1] for line in capsys.readouterr().out.splitlines() if "│" in line]
    none, most = ([cell.strip() for cell in line] for line in lines)
    assert none[:3] == ["0", "0.00", "+0.000"] and most[0] == "1" and float(most[1]) >= 0
