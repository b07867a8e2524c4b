"""All networks of the tables: trained by one command that resumes, then measured and drawn."""

import shlex
from pathlib import Path

import pytest
import torch
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

import pointsplat_ns as ps
from lab.tables import figures, networks
from lab.tables.measure import measure_tables
from lab.tables.networks import jobs
from lab.tables.scenes import run_or_file, scenes_at
from lab.tables.ways import WAYS
from making import box_room, write_run
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.refinement import Refiner, refiner_preset
from pointsplat_ns.refinement.weights import save_refiner

pytestmark = pytest.mark.usefixtures("quick")

NUMBER = {job.name: f"{number}/16" for number, job in enumerate(jobs(), 1)}
"""Shards of one network each."""


def check_training(words: list[str]) -> None:
    """Fail unless ``ns-train`` takes the arguments and its trainer their values."""
    config = tyro.cli(
        tyro.conf.FlagConversionOff[AnnotatedBaseConfigUnion], args=words[1:], prog=words[0]
    )
    config.check()


def written(command: str, log: Path) -> None:
    """In place of a training: weights with the metadata of one, by the options of its command."""
    words = shlex.split(command)
    check_training(words)
    given = {word[2:]: words[i + 1] for i, word in enumerate(words) if word.startswith("--")}
    model = {key.rpartition(".")[2]: value for key, value in given.items() if ".model." in key}
    switches = {name.replace("-", "_"): False for name in model if name.startswith("use-")}
    torch.manual_seed(int(given["pipeline.datamanager.seed"]))
    network = Refiner(refiner_preset(model["size"], encoder=model["encoder"], **switches))
    with torch.no_grad():
        [*network.heads.mlps["opacities"].modules()][-1].bias.fill_(0.3 * torch.rand(()))
    weight = {"opacity_weight": float(model["opacity-weight"])} if "opacity-weight" in model else {}
    known = {"by": model["by"], "keep": float(model["keep"]), **weight, "scenes": "wall-a"}
    known |= {
        "size": model["size"],
        "steps": int(given["max-num-iterations"]),
        "pixel_loss": model["pixel-loss"],
    }
    known["lpips_weight"] = float(model["lpips-weight"])
    folder = (
        Path(given["output-dir"]) / given["experiment-name"] / "pointsplat" / given["timestamp"]
    )
    save_refiner(network, folder / "refiner.safetensors", known)


@pytest.fixture()
def small(trained_walls, tmp_path, no_lpips):
    """A function that trains networks of size tiny for three steps, never on wall-b."""

    def train(**options):
        usual = {"held_out": ("wall-b",), "size": "tiny", "steps": 3}
        networks.main(trained_walls, tmp_path / "networks", **usual | options)

    return train


def test_an_interrupted_training_goes_on_where_it_was(small, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(networks, "run", lambda command, log: asked.append(shlex.split(command)))
    folder = tmp_path / "networks" / "pointsplat-iii-10" / "pointsplat" / "run"
    write_run(folder, 2, 5)
    small(shard=NUMBER["pointsplat-iii-10"], steps=5)
    options = dict(zip(asked[0], asked[0][1:], strict=False))
    assert (options["--max-num-iterations"], options["--load-dir"]) == (
        "3",
        str(folder / "nerfstudio_models"),
    )
    (folder / "refiner.safetensors").touch()
    small(shard=NUMBER["pointsplat-iii-10"])
    assert len(asked) == 1, "it is finished"


def test_networks_fill_all_rows_and_all_figures(small, room, measured, tmp_path, monkeypatch):
    monkeypatch.setattr(networks, "run", written)
    for shard in ("1/2", "2/2"):
        small(shard=shard, seeds=2)
    trained = tmp_path / "networks"
    monkeypatch.setattr(networks, "run", lambda *_: pytest.fail("all are finished"))
    small(seeds=2)
    ps.save(box_room(1, 300), tmp_path / "hall.ply")
    only = [
        f"*/{way.name}/10*"
        for way, _ in WAYS.cells((0.1,))
        if (way.network and not way.own) or way in WAYS.figure_4
    ]
    tables = measured(tmp_path / "hall.ply", refiners=[trained], only=only, keeps=(0.1,))
    assert tables.missing == {} and len({cell["way"] for cell in tables.cells.values()}) == len(
        set(only)
    )
    both = tables.cells["hall/pointsplat-ii/10%"]
    assert (
        len(both["psnr"]) == 2
        and both["made_with"].count("steps 3") == 1
        and "size tiny" in both["made_with"]
    )
    assert both["point"]["against_dense"]["psnr"] == pytest.approx(sum(both["psnr"]) / 2)
    page = (tmp_path / "tables" / "tables.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| II |")]
    [row] = [line.split(" | ") for line in rows if "| other scenes |" in line]
    assert row[-4] == f"{abs(both['psnr'][0] - both['psnr'][1]) / 2**0.5:.2f}"  # the spread of two
    assert row[-2] == "dual tiny, 3 steps, keep 0.1, rmse + 0.05 LPIPS"
    for number in (1, 3, 4, 5):
        target = tmp_path / f"figure{number}.png"
        figures.main(
            number,
            (tmp_path / ("tables" if number == 4 else "hall.ply"),),
            target,
            refiners=(trained,),
        )
        assert target.read_bytes().startswith(b"\x89PNG") and target.stat().st_size > 10_000


def test_a_folder_above_runs_is_measured_in_its_photos_under_its_own_path(
    trained_walls, tmp_path, no_lpips
):
    assert [*scenes_at(trained_walls)] == ["wall-a", "wall-b"]
    wall = trained_walls / "wall-a"
    assert scenes_at(wall) == {"wall-a": wall}
    assert (run_or_file(wall) / "config.yml").is_file()
    only = ["wall-a/dense/*", "wall-a/lightgaussian*/30%"]
    tables = measure_tables((wall,), tmp_path / "tables", keeps=(0.3,), only=only, fine_tune=4)
    cells = {key.split("/")[1]: cell for key, cell in tables.cells.items()}
    assert [*cells] == ["dense", "lightgaussian", "lightgaussian-tuned"]
    tuned = cells["lightgaussian-tuned"]
    assert f"lab.tables {wall} -o" in tuned["point"]["command"]
    assert "--fine-tune 4" in tuned["point"]["command"]
    psnr = {way: cell["point"]["against_photos"]["psnr"] for way, cell in cells.items()}
    steps, curve = zip(*tuned["curve"], strict=True)
    assert steps == (0, 1, 2, 4)
    assert curve[0] == pytest.approx(psnr["lightgaussian"], abs=1e-4)
    assert curve[-1] == pytest.approx(psnr["lightgaussian-tuned"], abs=1e-4)
    about = tables.scenes["wall-a"]
    assert about["views"] == 2 and "held-out photos" not in about["differs"]
    assert "30 of 15,000 Splatfacto steps" in about["differs"]


def test_networks_of_own_photos_are_trained_on_photos():
    both = [jobs(own=own) for own in (False, True)]
    assert len(both[0]) == len(both[1]) == 16
    assert {f"{job.name.rpartition('-')[0]}-own" for job in both[0]} == {
        job.name.rpartition("-")[0] for job in both[1]
    }
    assert both[1][0].way.network is not None
    options = both[1][0].way.network.options(0.1, own=True)
    assert options["pipeline.datamanager.supervision"] == "photos"


def test_a_figure_without_its_network_names_the_command_that_trains_it(room, tmp_path):
    with pytest.raises(
        PointSplatError, match="room: PointSplat cannot be drawn: no weights .*ns-train pointsplat"
    ):
        figures.main(1, (room,), tmp_path / "figure1.png")


@pytest.mark.parametrize("shard", ["", "3", "0/2", "3/2", "a/b"])
def test_a_shard_that_is_none_is_refused(shard, tmp_path):
    with pytest.raises(PointSplatError, match="expected I/N such as 1/3"):
        networks.main(tmp_path, tmp_path / "networks", shard=shard)
