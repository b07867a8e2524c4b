"""Networks of Table 4 that were trained alike: their gains, and what these decide."""

from lab.judge.encoders import lines, section, verdicts
from lab.tables.findings import Verdict


def row(method: str, number: int, scene: str, gain: float) -> dict:
    return {
        "method": method,
        "number": number,
        "scene": scene,
        "pruned_psnr": 10.0,
        "psnr": 10.0 + gain,
    }


ROWS = [
    row(method, 2 * place + seed, scene, gain + (0.5 if seed else -0.5))
    for place, (method, gains) in enumerate(
        {"pointsplat": (3.0, 5.0, 2.0), "paper-splatformer": (1.0, 2.5, -0.5)}.items()
    )
    for seed in (0, 1)
    for scene, gain in zip(("rock", "bouquet", "can"), gains, strict=True)
]


def test_gains_are_means_over_seeds_and_their_spread_is_that_of_seeds():
    assert lines(ROWS) == [
        ["V", "2 splats", "+4.00", "0.71", "+3.00 (rock)"],
        ["V", "1 captures", "+2.00", "0.71", "+2.00 (can)"],
        ["concat", "2 splats", "+1.75", "0.71", "+1.00 (rock)"],
        ["concat", "1 captures", "-0.50", "0.71", "-0.50 (can)"],
    ]


def test_a_claim_is_decided_by_the_difference_in_each_scene():
    [found] = verdicts(ROWS)  # other claims need models that are not here
    assert found.differences == (2.0, 2.5, 2.5) and found.verdict is Verdict.HOLDS
    assert "What holds here: the dual-branch encoder beats the concatenating one" in section(ROWS)
    assert "means over 2 seeds" in " ".join(section(ROWS).split())
