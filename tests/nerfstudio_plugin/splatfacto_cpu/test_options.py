"""Options and files that no training can have: one line before anything is written."""

import copy
import dataclasses
import json
import shutil

import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.scripts import train

from captures import Capture
from making import small_config
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.option_checks import RULES
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config

NAN = float("nan")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    Capture().write_nerfstudio(folder / "room")
    return folder / "room"


def config_of(data, output_dir, changes=None):
    config = splatfacto_cpu_config()
    config.machine.device_type = "cpu"
    config.data = data
    config.output_dir = output_dir
    config.max_num_iterations = 3
    config.pipeline.model.num_downscales = 0
    config.pipeline.model.num_random = 50
    for path, value in (changes or {}).items():
        place = config
        *inner, last = path.split(".")
        for name in inner:
            place = place[name] if isinstance(place, dict) else getattr(place, name)
        assert hasattr(place, last)
        setattr(place, last, value)
    return config


def refused(config, match):
    """Fail unless ns-train ends in one line and leaves nothing."""
    with pytest.raises(PointSplatError, match=match) as error:
        train.main(config)
    assert "\n" not in str(error.value) and not config.output_dir.exists()


MODEL = "pipeline.model"
DATA = "pipeline.datamanager"


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        (f"{MODEL}.sh_degree", -1, "a whole number from 0 to 3"),
        (f"{MODEL}.sh_degree", 9, "a whole number from 0 to 3"),
        (f"{MODEL}.num_random", -5, "a whole number, 1 or more"),
        (f"{MODEL}.refine_every", 0, "a whole number, 1 or more"),
        (f"{MODEL}.reset_alpha_every", 0, "a whole number, 1 or more"),
        (f"{MODEL}.num_downscales", 30, "the shortest side of the photos is 48 pixels"),
        (f"{MODEL}.num_downscales", 6, "expected 5 at most"),
        (f"{MODEL}.resolution_schedule", 0, "a whole number, 1 or more"),
        (f"{MODEL}.sh_degree_interval", 0, "a whole number, 1 or more"),
        (f"{MODEL}.grid_shape", (0, 16, 8), "a whole number, 1 or more"),
        (f"{MODEL}.random_scale", float("inf"), "a finite number above 0"),
        (f"{MODEL}.ssim_lambda", NAN, "a finite number from 0 to 1"),
        (f"{MODEL}.collider_params", {"near_plane": NAN}, "a finite number"),
        (f"{DATA}.cache_gigabytes", -1.0, "a finite number, 0 or more"),
        (f"{DATA}.camera_res_scale_factor", 1e-9, "0 x 0 pixels"),
        (f"{DATA}.dataparser.train_split_fraction", 0.0, "from 0 to 1, not 0"),
        (f"{DATA}.dataparser.eval_interval", 0, "2 or more"),
        ("optimizers.means.optimizer.lr", NAN, "a finite number, 0 or more"),
        ("optimizers.means.optimizer.max_norm", 0.0, "a finite number above 0"),
        ("optimizers.means.scheduler.max_steps", 0, "a whole number, 1 or more"),
        ("optimizers.means.scheduler.warmup_steps", 30_000, "less than the schedule's max-steps"),
        ("logging.steps_per_log", 0, "a whole number, 1 or more"),
        ("threads", 0, "a whole number from 1 to 1024"),
        ("machine.seed", -1, "a whole number from 0 to 4294967295"),
        ("machine.num_machines", 2, "--machine.dist-url"),
    ],
)
def test_an_option_that_no_training_can_have_is_refused_in_one_line(
    option, value, expected, capture, tmp_path
):
    config = config_of(capture, tmp_path / "out", {option: value})
    last = option.rpartition(".")[2].replace("_", "-")
    named = "photos of 0" if "res_scale" in option else f"--.*{last}.* "
    refused(config, f"{named}.*{expected}|{expected}")


def test_the_options_as_they_ship_are_taken_and_each_rule_is_of_an_option(capture, tmp_path):
    configs = [config_of(capture, tmp_path), small_config(capture, tmp_path, 2)]
    for config in configs:
        config.check()
    found = set()

    def walk(value):
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            for field in dataclasses.fields(value):
                found.add(field.name)
                walk(getattr(value, field.name))
        elif isinstance(value, dict):
            for part in value.values():
                walk(part)

    walk(configs)
    for config in configs:
        walk(config)
    walk(NerfstudioDataParserConfig())
    assert {name.rpartition(".")[2] for name in RULES} - found <= {"weight_decay"}  # of other Adams


@pytest.mark.parametrize("frames", [0, 1])
def test_a_capture_without_two_photos_is_refused_in_one_line(frames, capture, tmp_path):
    shutil.copytree(capture, tmp_path / "room")
    path = tmp_path / "room" / "transforms.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "frames": content["frames"][:frames]}))
    refused(config_of(tmp_path / "room", tmp_path / "out"), "room: .*expected two or more photos")


def test_data_that_is_not_there_is_refused_in_one_line(tmp_path):
    refused(config_of(tmp_path / "none", tmp_path / "out"), "none: .*expected two or more photos")


@pytest.fixture(scope="module")
def checkpoint(capture, tmp_path_factory):
    """A checkpoint of three steps, beside a file that is none."""
    config = config_of(capture, tmp_path_factory.mktemp("trained"))
    train.main(config)
    assert (config.get_base_dir() / "config.yml").is_file()
    (config.get_checkpoint_dir() / "notes.txt").touch()
    return next(config.get_checkpoint_dir().glob("*.ckpt"))


def damaged(content):
    for name in ("step", "pipeline", "optimizers", "scalers"):
        yield {key: value for key, value in content.items() if key != name}, f"lacks '{name}'"
    yield {**content, "step": -5}, "its step is -5"
    yield {**content, "pipeline": {}}, "same method and settings"
    other = copy.deepcopy(content)
    other["pipeline"]["_model.gauss_params.means"] = torch.zeros(3, 3)
    yield other, "same method and settings"
    yield {**content, "pointsplat": {}}, "same method and settings"
    yield {**content, "optimizers": {"strange": {}}}, "same method and settings"


def test_a_training_goes_on_from_a_whole_checkpoint_only(checkpoint, capture, tmp_path):
    bad = tmp_path / "bad" / checkpoint.name
    bad.parent.mkdir()
    whole = checkpoint.read_bytes()

    def each_way(match):
        for changes in ({"load_checkpoint": bad}, {"load_dir": bad.parent}):
            refused(config_of(capture, tmp_path / "out", changes), match)

    for content, match in (
        (whole[: len(whole) // 2], "truncated"),
        (b"", "the file is empty"),
        (b"words", "not a checkpoint"),
    ):
        bad.write_bytes(content)
        each_way(f"{bad.name}: .*{match}")
    for content, match in damaged(torch.load(checkpoint, weights_only=True)):
        torch.save(content, bad)
        each_way(f"{bad.name}: .*{match}")
    for changes, match in (
        ({"load_dir": tmp_path / "none"}, "--load-dir .*found none"),
        ({"load_dir": checkpoint.parent, "load_step": 7}, "step 7; found 2"),
        ({"load_checkpoint": tmp_path / "none.ckpt"}, "none.ckpt: no such file"),
        ({"load_dir": checkpoint.parent, f"{MODEL}.sh_degree": 1}, "same method and settings"),
    ):
        refused(config_of(capture, tmp_path / "out", changes), match)
    config = config_of(capture, tmp_path / "out", {"load_dir": checkpoint.parent})
    train.main(config)
    assert [path.name for path in config.get_checkpoint_dir().iterdir()] == ["step-000000005.ckpt"]


def test_a_training_that_fails_in_its_first_step_leaves_no_folder(capture, tmp_path, monkeypatch):
    shutil.copytree(capture, tmp_path / "room")
    for photo in (tmp_path / "room" / "images").iterdir():
        photo.write_bytes(photo.read_bytes()[:200])
    refused(config_of(tmp_path / "room", tmp_path / "out"), "cannot be read as the photo")
