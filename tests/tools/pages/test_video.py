"""Frames as videos, folders and pictures: whole, or nothing."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

import pointsplat_ns as ps
from making import decoded
from pointsplat_ns.tools.pages import video
from pointsplat_ns.tools.pages.video import check_output


def drawn(count: int = 6, width: int = 128, height: int = 96) -> list[np.ndarray]:
    """Smooth pictures that move."""
    y, x = np.mgrid[:height, :width]
    return [
        np.stack(
            [
                127 + 120 * np.sin(x / 20 + i),
                127 + 120 * np.cos(y / 15),
                127 + 99 * np.sin((x + y) / 30),
            ],
            -1,
        )
        .round()
        .astype(np.uint8)
        for i in range(count)
    ]


def write_frames(frames: Iterable[np.ndarray], path: Path, fps: float, force: bool = False) -> int:
    return video.write_frames(frames, path, check_output(path, force), fps)


def test_video_shows_the_frames_and_plays_everywhere(tmp_path):
    """H.264 with 4:2:0, its colours named, its index in front, so that it starts before all of it
    has come."""
    import av

    frames = drawn()
    assert write_frames(frames, tmp_path / "film.mp4", 29.97) == 6
    shown = decoded(tmp_path / "film.mp4")
    assert all(
        np.square(one - other.astype(float)).mean() < 65
        for one, other in zip(shown, frames, strict=True)
    )
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
    with pytest.raises(ps.SceneError, match="--force"):
        write_frames(drawn(2), tmp_path / "frames", 12)

    def interrupted() -> Iterator[np.ndarray]:
        yield drawn(1)[0] // 2
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_frames(interrupted(), tmp_path / "frames", 12, force=True)
    assert {path.name: path.read_bytes() for path in (tmp_path / "frames").iterdir()} == before
    write_frames(drawn(2), tmp_path / "frames", 12, force=True)
    assert len([*(tmp_path / "frames").iterdir()]) == 2, "frames of the longer film are gone"


def test_folders_of_others_are_left_alone(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.png").touch()
    (tmp_path / "file").touch()
    refused = {
        "photos": "contains cat.png; expected a new folder",
        "file": "expected the name of a folder",
        "film.avi": "cannot write a .avi file",
        "file/film.mp4": "cannot be written",
    }
    for name, words in refused.items():
        with pytest.raises(ps.SceneError, match=words):
            check_output(tmp_path / name, force=True)


def test_missing_encoder_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "ENCODER", "h264_of_nobody")
    with pytest.raises(ps.SceneError, match="has no h264_of_nobody; expected its wheel"):
        write_frames(drawn(1), tmp_path / "film.mp4", 12)
    assert not [*tmp_path.iterdir()]
