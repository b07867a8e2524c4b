"""The table that ns-eval prints."""

from pointsplat_ns.nerfstudio_plugin.pointsplat.evaluation import print_summary


def summary() -> dict:
    """Results of two scenes with photos, one of them never seen in training, and of one without photos."""

    def row(psnr: float | None, count: int) -> dict:
        return {"psnr": psnr, "ssim": 0.9, "lpips": None, "gaussians": count, "megabytes": count * 236e-6, "fps": 12.0}

    photos = {"dense": row(30.0, 1000), "pruned": row(20.0, 100), "refined": row(25.0, 100)}
    renders = {**photos, "dense": row(None, 1000)}
    return {
        "settings": {"keep": 0.1, "by": "paper", "size": "tiny"},
        "reference": "photos",
        "average": photos,
        "average_unseen": photos,
        "average_seen": photos,
        "scenes": {
            "a": {"seen_in_training": True, "reference": "photos", **photos},
            "b": {"seen_in_training": False, "reference": "photos", **photos},
            "c": {"seen_in_training": False, "reference": "dense renders", **renders},
        },
        "lpips_note": "no weights here",
    }


def test_the_table_shows_each_scene_and_mean_by_what_it_is_compared_with(capsys):
    print_summary(summary())
    shown = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in shown.splitlines() if "dense  " in line]
    figures = ["dense", "30.00", "0.900", "-", "1,000", "0.24", "12.0"]
    assert rows == [
        ["a", "yes", *figures],
        ["b", "never", *figures],
        ["c", "never", "dense", "-", *figures[2:]],
        *(["average", seen, *figures] for seen in ("", "yes", "never")),
    ]
    assert "keep 0.1, by paper, refiner tiny; compared with photos" in shown
    assert "compared with dense renders, and in no mean: c\n" in shown
    assert shown.endswith("no LPIPS: no weights here\n")
