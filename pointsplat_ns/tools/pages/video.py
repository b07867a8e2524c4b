"""Writes frames to an MP4 video, a folder of PNG files, or one PNG file: all or nothing."""

from __future__ import annotations

import re
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from pointsplat_ns.errors import SceneError
from pointsplat_ns.system.files import (
    need_folder,
    need_writable,
    one_line,
    replacing,
    replacing_folder,
)
from pointsplat_ns.system.outputs import claim

Kind = Literal["video", "frames", "picture"]

ENCODER = "libx264"
"""H.264 encoder of ffmpeg. PyAV's wheels include it; other builds may not."""

_FRAME = re.compile(r"frame_\d{5,}\.png")


def check_output(output: Path | str, force: bool) -> Kind:
    """The kind of an output, checked before long work: a video (.mp4), one picture (.png), or a
    folder of frames (no suffix). Raises SceneError if the path has another suffix, cannot be
    written, or must not be overwritten."""
    path = Path(output)
    if path.is_dir() or not path.suffix:
        need_folder(path)
        if not force:
            claim(path)
        found = sorted(item.name for item in path.iterdir()) if path.exists() else []
        if others := [name for name in found if not _FRAME.fullmatch(name)]:
            raise SceneError(
                f"{path}: contains {others[0]}; expected a new folder, or a folder of frames"
            )
        if found and not force:
            raise SceneError(
                f"{path}: contains frames; name another folder, or overwrite them with --force"
            )
        return "frames"
    kinds: dict[str, Kind] = {".mp4": "video", ".png": "picture"}
    kind = kinds.get(path.suffix.lower())
    if kind is None:
        raise SceneError(
            f"{path}: cannot write a {path.suffix} file; expected a video (.mp4), a picture (.png) "
            "or a folder (a name without a dot)"
        )
    need_writable(path, force)
    return kind


def write_frames(
    frames: Iterable[np.ndarray], path: Path, kind: Kind, fps: float, force: bool = True
) -> int:
    """Write all frames, (H, W, 3) uint8 each, or nothing, and return their number.

    Frames of a video have the same even width and height; a picture is one frame. Existing files
    are replaced, a folder with frames only if ``force``. Raises SceneError if the output cannot be
    written."""
    if kind == "video":
        return _write_video(frames, path, fps)
    if kind == "frames":
        return _write_folder(frames, path, force)
    [pixels] = frames
    with replacing(path) as part:
        Image.fromarray(pixels).save(part, format="PNG")
    return 1


def _write_folder(frames: Iterable[np.ndarray], folder: Path, force: bool) -> int:
    """Write frames to a new folder, which then replaces ``folder``."""
    count = 0
    with replacing_folder(folder, "frame_00000.png", _FRAME.pattern, force) as part:
        for pixels in frames:
            Image.fromarray(pixels).save(part / f"frame_{count:05d}.png")
            count += 1
    return count


def _write_video(frames: Iterable[np.ndarray], path: Path, fps: float) -> int:
    import av
    from av.codec.codec import UnknownCodecError
    from av.video.reformatter import ColorRange, Colorspace

    count = 0
    with replacing(path) as part:
        try:
            with av.open(
                str(part), "w", format="mp4", options={"movflags": "+faststart"}
            ) as container:
                rate = Fraction(fps).limit_denominator(1001)
                stream = container.add_stream(ENCODER, rate=rate, options={"crf": "18"})
                for pixels in frames:
                    if count == 0:
                        stream.height, stream.width = pixels.shape[:2]
                        stream.pix_fmt = "yuv420p"
                        stream.gop_size = max(round(fps), 1)  # for quick seeking
                        context = stream.codec_context
                        bt709 = 1  # written to the file
                        context.colorspace = context.color_primaries = context.color_trc = bt709
                        context.color_range = ColorRange.MPEG
                    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
                    frame = frame.reformat(
                        format="yuv420p",
                        dst_colorspace=Colorspace.ITU709,
                        dst_color_range=ColorRange.MPEG,
                    )
                    frame.pts = count
                    container.mux(stream.encode(frame))
                    count += 1
                container.mux(stream.encode())
        except UnknownCodecError as error:
            raise SceneError(
                f"{path}: PyAV {av.__version__} has no {ENCODER}; expected its wheel (pip install "
                "--force-reinstall --only-binary av av), or write frames: a name without a dot"
            ) from error
        except av.FFmpegError as error:  # such as a full disk
            raise OSError(one_line(error)) from error
    return count
