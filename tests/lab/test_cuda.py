"""The program for GPU machines, tried on the CPU."""

import pytest
import torch

import golden
from lab.speed import cuda

pytestmark = pytest.mark.usefixtures("quick")


def test_every_check_passes_where_both_devices_are_the_cpu(coarse_rooms, capsys):
    with pytest.raises(SystemExit) as ended:
        cuda.main(device="cpu", steps=4, every=160, resolution=(64, 48))
    lines = capsys.readouterr().out.splitlines()
    assert ended.value.code == 0, lines
    assert "8 of 8 passed" in lines[-1]


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ([(100, 30.0), (100, 30.09)], None),
        ([(100, 30.0), (101, 30.0)], "101 Gaussians; expected 100, as on the CPU"),
        ([(100, 30.0), (100, 29.8)], "29.80 dB; expected 30.00, as on the CPU"),
        ([(100, 30.0), (100, float("nan"))], "nan dB; expected 30.00, as on the CPU"),
    ],
)
def test_a_device_fails_that_keeps_another_number_or_loses_more(found, said, capsys):
    assert cuda.passes("prune", lambda: cuda.compared(found)) == (said is None)
    printed = capsys.readouterr().out
    assert (
        printed.startswith("pass  prune" if said is None else "FAIL  prune")
        and (said or "dB") in printed
    )


def test_checks_that_fail_are_said_and_end_it_with_status_1(monkeypatch, capsys):
    monkeypatch.setattr(cuda, "rasterization", None)
    monkeypatch.setattr(golden, "TOLERANCES", {torch.float32: (0.0, 0.0)})
    for name in ("pruned", "compacted"):
        monkeypatch.setattr(cuda, name, lambda *arguments: "not tried")
    for name in ("of_a_scene", "of_a_refiner"):
        monkeypatch.setattr(cuda.Trainings, name, lambda self: "not tried")
    with pytest.raises(SystemExit) as ended:
        cuda.main(device="cpu", every=80)
    printed = capsys.readouterr().out
    assert ended.value.code == 1
    assert (
        "FAIL  golden pictures" in printed
        and "FAIL  times of torch" in printed
        and "6 of 8 passed" in printed
    )
