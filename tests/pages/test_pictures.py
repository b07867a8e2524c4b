"""Pictures of pages: what is read, what an error map shows, how they are made to fit."""

import base64
import io

import numpy as np
import pytest
from PIL import Image

from pointsplat_ns.errors import DataError
from pointsplat_ns.pages.pictures import ERROR_GAIN, error_colors, error_map, fit, read_png

SEED = 3
noise = np.random.default_rng(SEED).integers(0, 256, (12, 48, 64, 3), dtype=np.uint8)


def decoded(uri: str) -> Image.Image:
    kind, content = uri.split(",", 1)
    assert kind == "data:image/webp;base64"
    return Image.open(io.BytesIO(base64.b64decode(content, validate=True)))


def test_a_png_is_read_exactly(tmp_path):
    Image.fromarray(noise[0]).save(tmp_path / "a.png")
    assert np.array_equal(read_png(tmp_path / "a.png", 64, 48), noise[0])


@pytest.mark.parametrize(
    ("content", "found"),
    [(None, "No such file"), (b"GIF89a", "not a PNG"), ("cut", "cannot be read"), ("wide", "48 x 64")],
)
def test_a_picture_that_cannot_be_used_is_one_line_with_its_path(tmp_path, content, found):
    path = tmp_path / "a.png"
    if content == "wide":
        Image.fromarray(noise[0].transpose(1, 0, 2)).save(path)
    elif content == "cut":
        Image.fromarray(noise[0]).save(path)
        path.write_bytes(path.read_bytes()[:200])
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError) as error:
        read_png(path, 64, 48)
    text = str(error.value)
    assert text.startswith(str(path)) and found in text and "expected a PNG picture of 64 x 48" in text
    assert "\n" not in text


def test_a_picture_of_another_size_is_refused_before_its_pixels_are_read(tmp_path, monkeypatch):
    Image.new("RGB", (3000, 3000)).save(tmp_path / "large.png")
    monkeypatch.setattr(Image.Image, "convert", lambda *args: pytest.fail("read"))
    with pytest.raises(DataError, match="3000 x 3000"):
        read_png(tmp_path / "large.png", 64, 48)


def test_error_colors_get_brighter_all_the_way():
    brightness = error_colors() @ np.array([0.2126, 0.7152, 0.0722])
    assert (np.diff(brightness) > 0).all() and brightness[0] == 0 and brightness[-1] == pytest.approx(255)


def test_an_error_map_shows_the_mean_of_the_largest_difference_amplified():
    picture = noise[0].copy()
    other = picture.astype(int)
    other[:2, :2, 0] += np.array([[8, 4], [0, 0]]) * np.where(picture[:2, :2, 0] < 128, 1, -1)
    other[:2, :2, 2] += np.array([[2, 2], [2, 2]]) * np.where(picture[:2, :2, 2] < 128, 1, -1)
    shown = error_map(other.astype(np.uint8), picture)
    assert shown.shape == (24, 32, 3)
    assert np.array_equal(shown[0, 0], error_colors()[round(ERROR_GAIN * (8 + 4 + 2 + 2) / 4)])
    assert not shown[1:].any() and not shown[0, 1:].any()


def test_an_error_map_of_odd_size_covers_the_last_row_and_column():
    picture = np.zeros((3, 5, 3), np.uint8)
    other = picture.copy()
    other[2, 4] = 20
    shown = error_map(other, picture)
    assert shown.shape == (2, 3, 3) and np.array_equal(shown[1, 2], error_colors()[160])
    assert shown.any(axis=2).sum() == 1


def test_pictures_are_kept_well_where_there_is_room():
    uris, how = fit([lambda i=i: noise[i] for i in range(4)], 10**6)
    assert [decoded(uri).size for uri in uris] == [(64, 48)] * 4 and how == "WebP of quality 90"


def test_pictures_are_compressed_no_more_than_needed():
    pictures = [lambda i=i: noise[i] for i in range(12)]
    fitted = {limit: fit(pictures, limit) for limit in (60_000, 40_000)}
    assert all(0.7 * limit < sum(map(len, uris)) <= limit for limit, (uris, _) in fitted.items())
    assert fitted[60_000][1] != fitted[40_000][1]


def test_pictures_are_made_smaller_where_quality_alone_is_not_enough():
    big = np.random.default_rng(SEED).integers(0, 256, (300, 400, 3), dtype=np.uint8)
    [uri], how = fit([lambda: big], 45_000)
    assert decoded(uri).size == (160, 120) and how.endswith("at most 160 pixels wide or high")


def test_pictures_that_cannot_fit_are_an_error():
    with pytest.raises(DataError, match="12 pictures do not fit into 0.0 MB"):
        fit([lambda i=i: noise[i] for i in range(12)], 1_000)
