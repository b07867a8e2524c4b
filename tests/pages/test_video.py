"""Videos, also of two scenes side by side."""

from collections.abc import Iterator

import numpy as np
import pytest

import pointsplat_ns as ps
from making import cloud, decoded
from pointsplat_ns.pages import video
from pointsplat_ns.pages.film import to_uint8, wiped, with_labels
from pointsplat_ns.pages.video import write_frames


def drawn(count: int = 6, width: int = 128, height: int = 96) -> list[np.ndarray]:
    """Smooth pictures that move."""
    y, x = np.mgrid[:height, :width]
    return [
        np.stack([127 + 120 * np.sin(x / 20 + i), 127 + 120 * np.cos(y / 15), 127 + 99 * np.sin((x + y) / 30)], -1)
        .round()
        .astype(np.uint8)
        for i in range(count)
    ]


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.square(a.astype(float) - b).mean()))


def test_frames_of_a_video_are_those_drawn(tmp_path):
    frames = drawn()
    assert write_frames(frames, tmp_path / "film.mp4", 12) == 6
    shown = decoded(tmp_path / "film.mp4")
    assert len(shown) == 6
    assert all(psnr(one, other) > 30 for one, other in zip(shown, frames, strict=True))
    assert psnr(shown[0], frames[3]) < 20


def test_video_plays_everywhere(tmp_path):
    """H.264 with 4:2:0, its colours named, its index in front, so that it starts before all of it has come."""
    import av

    write_frames(drawn(), tmp_path / "film.mp4", 29.97)
    with av.open(str(tmp_path / "film.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.average_rate) == pytest.approx(29.97, rel=1e-4)
        assert int(stream.codec_context.colorspace) == 1, "BT.709"
    content = (tmp_path / "film.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")


@pytest.mark.parametrize("name", ["film.mp4", "frames", "deeper/frames"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_nothing_is_left_of_what_was_interrupted(name, error, tmp_path):
    def interrupted() -> Iterator[np.ndarray]:
        yield from drawn(3)
        raise error

    with pytest.raises(error):
        write_frames(interrupted(), tmp_path / name, 12)
    assert [path for path in tmp_path.rglob("*") if path.name != "deeper"] == []


def test_what_was_there_stays_until_all_is_written(tmp_path):
    write_frames(drawn(4), tmp_path / "frames", 12)
    before = {path.name: path.read_bytes() for path in (tmp_path / "frames").iterdir()}

    def interrupted() -> Iterator[np.ndarray]:
        yield drawn(1)[0] // 2
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_frames(interrupted(), tmp_path / "frames", 12, force=True)
    assert {path.name: path.read_bytes() for path in (tmp_path / "frames").iterdir()} == before
    write_frames(drawn(2), tmp_path / "frames", 12, force=True)
    assert len([*(tmp_path / "frames").iterdir()]) == 2, "frames of the longer film are gone"


@pytest.mark.parametrize("name", ["film.mp4", "one.png", "frames"])
def test_nothing_is_overwritten_unasked(name, tmp_path):
    write_frames(drawn(1), tmp_path / name, 12)
    with pytest.raises(ps.SceneError, match="--force"):
        write_frames(drawn(1), tmp_path / name, 12)
    write_frames(drawn(1), tmp_path / name, 12, force=True)


def test_folders_of_others_are_left_alone(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.png").touch()
    with pytest.raises(ps.SceneError, match="holds cat.png; expected a new folder"):
        write_frames(drawn(1), tmp_path / "photos", 12, force=True)
    (tmp_path / "file").touch()
    with pytest.raises(ps.SceneError, match="expected a new folder"):
        write_frames(drawn(1), tmp_path / "file", 12, force=True)
    with pytest.raises(ps.SceneError, match="cannot write a .avi file"):
        write_frames(drawn(1), tmp_path / "film.avi", 12)
    with pytest.raises(ps.SceneError, match="cannot be written"):
        write_frames(drawn(1), tmp_path / "file" / "film.mp4", 12)


def test_missing_encoder_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "ENCODER", "h264_of_nobody")
    with pytest.raises(ps.SceneError, match="has no h264_of_nobody; expected its wheel"):
        write_frames(drawn(1), tmp_path / "film.mp4", 12)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("column", [0, 33, 70])
def test_each_side_of_a_wipe_is_the_render_of_its_scene(column):
    first = cloud(300)
    second = first.replace(features_dc=-first.features_dc)
    view = ps.sample_views(first, 1, 70, 44)[0]
    shown = wiped([first, second], view, column)
    left, right = (to_uint8(ps.render(scene, view)) for scene in (first, second))
    for pixels, part in ((left, slice(0, max(column - 2, 0))), (right, slice(min(column + 2, 70), None))):
        assert np.array_equal(shown[:, part], pixels[:, part]), "all but the line"
    assert (shown[:, min(column, 69)] == 255).all() == (column == 33)


def test_labels_stand_at_the_top_of_their_sides():
    blank = np.full((200, 400, 3), 128, np.uint8)
    both = with_labels(blank, ["dense", "ein Zehntel, 小"], 200) != 128
    assert both[:40, :200].any() and both[:40, 200:].any() and not both[40:].any()
    assert not (with_labels(blank, ["", "second"], 200)[:, :200] != 128).any()
    narrow = with_labels(blank, ["first", "second"], 30) != 128
    assert not narrow[:, :200].any() and narrow[:, 200:].any(), "no room on the left"
