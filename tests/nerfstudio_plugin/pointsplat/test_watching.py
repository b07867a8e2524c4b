"""What is said, written and drawn of a training: gains by scene, the time left, the verdict."""

import csv
from unittest import mock

import cv2
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from making import dense_config, fast_config
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config
from pointsplat_ns.nerfstudio_plugin.pointsplat.evaluation import COMPARED, labelled
from pointsplat_ns.nerfstudio_plugin.pointsplat.presets import authors_config, paper_config
from pointsplat_ns.nerfstudio_plugin.pointsplat.progress import Curves, Progress, spread
from pointsplat_ns.nerfstudio_plugin.pointsplat.verdict import (
    SceneGain,
    gains_line,
    selection_text,
    verdict,
)


def gain_of(own: float | None, others: float | None) -> list[SceneGain]:
    scenes = [("a", True, own), ("b", False, others)]
    return [
        SceneGain(name=name, trained_on=trained_on, views=2, pruned=16.0, refined=16.0 + gain)
        for name, trained_on, gain in scenes
        if gain is not None
    ]


@pytest.mark.parametrize(
    ("own", "others", "said"),
    [
        (
            2.3,
            -0.2,
            "gains 2.3 dB in its own scenes, loses 0.2 dB in others: more scenes, not more steps",
        ),
        (2.3, 0.4, "gains 2.3 dB in its own scenes, 0.4 dB in others: more scenes, not more steps"),
        (
            2.3,
            1.9,
            "gains 2.3 dB in its own scenes, 1.9 dB in others: it carries over; more steps may "
            "gain more",
        ),
        (
            0.0,
            0.0,
            "gains nothing in its own scenes, gains nothing in others: more steps, or higher rates "
            "(--rate-factor)",
        ),
        (-1.0, None, "loses 1.0 dB in its own scenes: more steps, or higher rates (--rate-factor)"),
        (None, 0.5, "gains 0.5 dB in scenes that it was not trained on"),
        (None, None, ""),
    ],
)
def test_the_verdict_says_what_would_gain_more(own, others, said):
    assert verdict(gain_of(own, others)) == said


def test_without_a_held_out_scene_the_verdict_says_how_to_hold_one_out():
    assert "--pipeline.datamanager.eval-scenes" in verdict(gain_of(2.3, None))


def test_a_line_has_the_held_out_scenes_apart():
    assert gains_line(gain_of(1.7, -0.2)) == (
        "pruned 16.0 -> refined 17.7 dB; scenes not trained on 16.0 -> 15.8"
    )


def test_the_method_is_the_papers_and_says_so():
    configs = [pointsplat_config(), paper_config()]
    for config in configs:
        text = selection_text(config.pipeline.model.prune_settings())
        assert text == "selection: PointSplat's score (eq. 3), lambda 0.3, 30 %"
    config.pipeline.model.opacity_weight = 0.5
    config.pipeline.model.keep = "10%"
    text = selection_text(config.pipeline.model.prune_settings())
    assert text.endswith("lambda 0.5, 10 %")
    config = authors_config()
    assert "released code" in selection_text(config.pipeline.model.prune_settings())
    config = pointsplat_config()
    config.pipeline.model.by = "merge"
    text = selection_text(config.pipeline.model.prune_settings())
    assert "merging" in text and "not the paper's" in text and "lambda" not in text


@pytest.mark.parametrize(("by", "factor"), [("paper", 10.0), ("opacity", 10.0), ("merge", 1.0)])
def test_scenes_that_a_score_selects_are_learned_at_higher_rates(by, factor):
    config = pointsplat_config()
    config.pipeline.model.by = by
    config.check()
    assert config.rate_factor == factor
    config.rate_factor = 2.5
    config.check()
    assert config.rate_factor == 2.5


def test_a_seed_that_has_no_effect_names_the_one_that_has():
    config = pointsplat_config()
    config.machine.seed = 7
    with pytest.raises(PointSplatError, match="--pipeline.datamanager.seed 7"):
        config.check()


@pytest.fixture(scope="module")
def watched(trained_walls, run_training, tmp_path_factory):
    """A short training on wall-a, measured after each second step; what it printed, and the
    trainer."""
    config = fast_config(trained_walls, tmp_path_factory.mktemp("watched"), 6)
    config.pipeline.datamanager.eval_scenes = ("wall-b",)
    config.steps_per_eval_image = 2
    config.logging.steps_per_log = 1
    with (
        mock.patch.object(Progress, "due", lambda self, seconds: True),
        mock.patch("pointsplat_ns.nerfstudio_plugin.pointsplat.trainer.say") as say,
    ):
        trainer, losses = run_training(config)
    return trainer, losses, [call.args[0] for call in say.call_args_list]


def test_lines_tell_the_loss_and_the_gains_of_both_kinds_of_scenes(watched):
    trainer, _, lines = watched
    first, *_, last = trainer.progress.curves.measurements
    assert [at.step for at in trainer.progress.curves.measurements] == [0, 2, 4, 6]
    assert [gain.refined for gain in first.gains] == [gain.pruned for gain in first.gains]
    steps = [line for line in lines if line.startswith("step ")]
    assert steps[0].startswith("step 0 of 6; pruned ") and "scenes not trained on " in steps[0]
    assert (
        steps[1].startswith("step 2 of 6; loss ")
        and gains_line(trainer.progress.curves.measurements[1].gains) in steps[1]
    )
    assert verdict(last.gains) in lines
    assert any("tensorboard --logdir" in line for line in lines)


def test_measured_gains_are_those_of_ns_eval_in_the_same_views(watched):
    trainer, _, _ = watched
    pipeline = trainer.pipeline
    report = pipeline.get_average_eval_image_metrics(step=None)
    for gain in trainer.progress.curves.measurements[-1].gains:
        block = report["scenes"][gain.name]
        assert gain.views == block["views"] == 2, "all held-out photos of these walls"
        assert gain.trained_on == block["seen_in_training"] == (gain.name == "wall-a")
        # float32 renders, in two processes' order of views
        assert gain.pruned == pytest.approx(block["pruned"]["psnr"], abs=1e-3)
        assert gain.refined == pytest.approx(block["refined"]["psnr"], abs=1e-3)


def test_curves_have_the_names_of_scenes_and_are_smoothed(watched):
    trainer, losses, _ = watched
    (path,) = trainer.base_dir.glob("events.out.tfevents.*")
    events = EventAccumulator(str(path), size_guidance={"images": 0}).Reload()
    names = set(events.Tags()["scalars"])
    assert {"gain dB, scenes trained on/wall-a", "gain dB, scenes not trained on/wall-b"} <= names
    assert not any("Metrics Dict/scene" in name or "Rays" in name for name in names)
    smoothed = [event.value for event in events.Scalars("loss, smoothed/wall-a")]
    assert len(smoothed) == len(losses) == 6
    assert max(smoothed) - min(smoothed) < max(losses) - min(losses)
    pictures = set(events.Tags()["images"])
    assert pictures == {f"photo | dense | pruned | refined/wall-{name}" for name in "ab"}


def test_a_table_and_pictures_lie_in_the_folder_of_the_run(watched):
    trainer, _, lines = watched
    with (trainer.base_dir / "training.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["step"], row["scene"], row["trained_on"]) for row in rows] == [
        (str(step), name, str(name == "wall-a"))
        for step in (0, 2, 4, 6)
        for name in ("wall-a", "wall-b")
    ]
    last = trainer.progress.curves.measurements[-1].gains[0]
    assert float(rows[-2]["gain_db"]) == pytest.approx(last.gain, abs=1e-3)
    for name in ("training.png", "views.png"):
        picture = cv2.imread(str(trainer.base_dir / name))
        assert picture is not None and picture.std() > 10, name
        assert any(name in line for line in lines)


def test_measuring_changes_no_step_and_takes_a_small_share(trained_walls, run_training, tmp_path):
    results = []
    for every in (0, 1):
        config = fast_config(trained_walls, tmp_path / str(every), 4)
        config.steps_per_eval_image = every
        config.pipeline.model.norm = "batch"  # has running statistics
        _, losses = run_training(config)
        results.append(losses)
    assert results[0] == results[1]
    progress = object.__new__(Progress)
    progress.spent = 3.0
    progress.latest = 2.0
    assert not progress.due(99.0) and progress.due(100.0), "a twentieth"


def test_the_time_left_is_that_of_the_clock_or_of_the_steps_to_come(trained_walls, tmp_path):
    config = fast_config(trained_walls, tmp_path, 100)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    assert trainer.seconds_left(10) is None
    trainer._step_seconds.extend([60.0, 2.0, 2.0, 2.0, 2.0])  # the first one also samples views
    assert trainer.seconds_left(40) == 120.0
    trainer.config.seconds = 480.0
    trainer.pipeline.seconds = 96.0
    assert trainer.seconds_left(40) == 384.0, "after a fifth of eight minutes"


def test_of_many_scenes_some_are_measured_spread_over_all():
    assert spread(list(range(5))) == list(range(5)) and spread([]) == []
    assert len(spread(list(range(100)))) == 8 and spread(list(range(100)))[-1] > 90


def test_losses_are_smoothed_by_scene():
    curves = Curves()
    for step, (scene, loss) in enumerate([("a", 1.0), ("b", 3.0), ("a", 1.0), ("b", 3.0)]):
        curves.add_loss(step, scene, loss)
    assert [loss for _, loss in curves.loss_history] == pytest.approx([1.0, 2.0, 2.0, 2.0])


def test_other_ways_are_compared_at_the_same_count_where_asked_for(
    evaluated, monkeypatch, no_lpips, capsys
):
    monkeypatch.setenv(COMPARED, "merge, compact")
    monkeypatch.setattr(
        "pointsplat_ns.pipeline.repair_budget.STEPS", {"instant": 0, "quick": 2, "thorough": 4}
    )
    report = evaluated.get_average_eval_image_metrics()
    for block in report["scenes"].values():
        counts = {name: block[name]["gaussians"] for name in ("pruned", "by merge", "compact")}
        assert len(set(counts.values())) == 1
        assert block["by merge"]["psnr"] > block["pruned"]["psnr"], "a wall with holes"
    shown = capsys.readouterr().out
    assert "by merge" in shown and "compact" in shown
    monkeypatch.setenv(COMPARED, "magic")
    with pytest.raises(PointSplatError, match=f"{COMPARED}: no way is called magic"):
        evaluated.get_average_eval_image_metrics()


def test_labels_stand_over_pictures_of_any_width():
    for width in (8, 64, 1200):
        pictures = [torch.full((6, width, 3), value) for value in (0.0, 0.25, 0.5)]
        found = labelled(pictures, ["photo", "dense", "refined"], ["", "24.3 dB", "18.3 dB"])
        assert found.shape[1:] == (3 * width, 3)
        for place, picture in enumerate(pictures):
            assert torch.equal(found[-6:, place * width : (place + 1) * width], picture)


def test_a_dense_scene_is_its_own_photo(three_rooms, run_training, tmp_path):
    config = dense_config(three_rooms, tmp_path, 1)
    config.steps_per_eval_image = 0
    trainer, _ = run_training(config)
    assert list(trainer.progress.pictures(0)) == ["dense", "pruned", "refined"]
    assert (trainer.base_dir / "views.png").is_file()


def test_an_interrupted_training_draws_how_far_it_came(watched):
    trainer, _, _ = watched
    paths = [trainer.base_dir / name for name in ("training.csv", "training.png", "views.png")]
    for path in paths:
        path.unlink()
    trainer.show_progress()
    assert all(path.is_file() for path in paths)
