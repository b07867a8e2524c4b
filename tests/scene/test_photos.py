"""Photos of the cameras of a file: which file each is, and its pixels as a pinhole sees them."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from captures import FRAMES, HEIGHT, OPENCV_TO_OPENGL, WIDTH, Capture, Lens, colors_at, seen_from
from hostile import POSTSCRIPT, png_of, webp_of
from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.lenses import lens_of, pixel_map
from pointsplat_ns.scene.camera_files import read_named_views
from pointsplat_ns.scene.camera_files.camera_views import Camera
from pointsplat_ns.scene.photo_files import PhotoReader, photo_files, photos_of_cameras

BENT = Lens(distortion=(-0.2, 0.05, 0.004, -0.003))
FISHEYE = Lens("OPENCV_FISHEYE", (-0.02, 0.004, 0.0, 0.0))


def camera(width: int = 64, height: int = 48, **changes) -> Camera:
    pose = torch.eye(4).flatten().tolist()
    return Camera("a.png", pose, (width, height), (50.0, 50.0), (width / 2, height / 2))._replace(
        **changes
    )


def saved(array: np.ndarray, path: Path, **options) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path, **options)
    return path


def noise(width: int = 64, height: int = 48, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(5).integers(0, 256, (height, width, channels), dtype=np.uint8)


@pytest.mark.parametrize(
    ("kind", "lens"),
    [("colmap", Lens()), ("transforms.json", BENT), ("colmap", FISHEYE)],
    ids=["pinhole", "opencv", "fisheye"],
)
def test_photos_of_any_lens_are_those_of_a_pinhole(kind, lens, tmp_path):
    """The room is painted exactly: what a pinhole sees is known at each pixel."""
    capture = Capture(lens)
    if kind == "colmap":
        capture.write_colmap(tmp_path / "sparse" / "0", capture.write_photos(tmp_path / "images"))
        named = read_named_views(tmp_path)
    else:
        named = read_named_views(capture.write_nerfstudio(tmp_path))
    folder = tmp_path / "images"
    files = photos_of_cameras(folder, photo_files(folder), named)
    reader = PhotoReader(tmp_path, 1000)
    assert list(files) == list(range(FRAMES))
    for index in (0, 4):
        photo = reader.read(files[index], named.cameras[index])
        u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        K = photo.K.numpy()
        rays = np.stack(
            [(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1
        )
        pose = capture.poses[index]
        expected = colors_at(seen_from(pose[:3, 3], rays @ (pose @ OPENCV_TO_OPENGL)[:3, :3].T))
        apart = np.abs(photo.image.numpy() / 255 - expected).max(axis=-1)
        shown = (
            np.ones_like(apart, dtype=bool) if photo.mask is None else photo.mask[..., 0].numpy()
        )
        assert (photo.mask is None) == (lens.model == "OPENCV" and not any(lens.distortion))
        assert shown.mean() > 0.9
        # Bilinear sampling of smooth walls, and rounding to 8 bits twice; edges of walls are few
        # pixels.
        assert np.quantile(apart[shown], 0.98) < 2.5 / 255


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("SIMPLE_RADIAL", (0.08,)),
        ("RADIAL", (-0.2, 0.06)),
        ("OPENCV", (-0.2, 0.05, 0.01, -0.02)),
        ("FULL_OPENCV", (0.1, -0.05, 0.002, 0.001, 0.02, 0.01, 0.002, 0.001)),
        ("OPENCV_FISHEYE", (-0.03, 0.01, -0.004, 0.001)),
        ("SIMPLE_RADIAL_FISHEYE", (0.03,)),
    ],
)
def test_pixels_lie_where_opencv_says(model, distortion):
    import cv2

    K = np.array([[90.0, 0, 60.5], [0, 92.0, 44.0], [0, 0, 1]])
    from_zero = K - np.array(
        [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    )  # OpenCV's first pixel has its centre at 0
    lens = lens_of(model, distortion)
    assert lens is not None
    map_of = (cv2.fisheye if lens.fisheye else cv2).initUndistortRectifyMap
    x, y = map_of(from_zero, np.array(lens.params), np.eye(3), from_zero, (120, 90), cv2.CV_32FC1)
    places, shown = pixel_map(lens, torch.tensor(K), 120, 90)
    expected = torch.stack(
        [torch.from_numpy(x + 0.5) * 2 / 120 - 1, torch.from_numpy(y + 0.5) * 2 / 90 - 1], -1
    )
    assert float(shown.double().mean()) > 0.8
    assert torch.allclose(places[shown], expected[shown], atol=1e-5)


def test_beyond_where_a_polynomial_turns_back_no_pixel_is_shown():
    """r - 0.5 r^3 is largest at 0.816; radii in the picture go up to 1.25."""
    K = torch.tensor([[40.0, 0, 40], [0, 40.0, 30], [0, 0, 1]], dtype=torch.float64)
    lens = lens_of("SIMPLE_RADIAL", (-0.5,))
    assert lens is not None
    _, shown = pixel_map(lens, K, 80, 60)
    x, y = torch.meshgrid(torch.arange(80) - 39.5, torch.arange(60) - 29.5, indexing="xy")
    radii = torch.hypot(x, y)
    assert not shown[radii / 40 > 0.82].any() and shown[radii / 40 < 0.81].all()


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"model": "FOV", "distortion": (0.9,)}, "distortion of the model FOV"),
        ({"model": "OPENCV", "distortion": (-1e6, 0.0, 0.0, 0.0)}, "leaves no pixels"),
        ({"mask": "../secret.png"}, "no such mask"),
        ({"size": (48, 64)}, "64 x 48 pixels, but its camera is for 48 x 64"),
    ],
)
def test_cameras_that_do_not_fit_a_photo_are_refused(changes, text, tmp_path):
    saved(noise(), tmp_path.parent / "secret.png")
    path = saved(noise(), tmp_path / "a.png")
    with pytest.raises(DataError, match=text):
        PhotoReader(tmp_path, 1000).read(path, camera(**changes))


def test_photos_are_reduced_while_read_and_never_enlarged(tmp_path):
    path = saved(np.full((600, 800, 3), (10, 200, 90), np.uint8), tmp_path / "a.jpg", quality=95)
    shot = camera(
        4000, 3000, focal=(3000.0, 3000.0), centre=(1990.0, 1510.0)
    )  # the photo is a smaller copy
    photo = PhotoReader(tmp_path, 160).read(path, shot)
    assert (
        photo.image.shape == (120, 160, 3)
        and photo.image.dtype == torch.uint8
        and photo.mask is None
    )
    assert photo.image.float().mean((0, 1)).tolist() == pytest.approx([10, 200, 90], abs=2)
    assert photo.K[:2].flatten().tolist() == pytest.approx([120, 0, 79.6, 0, 120, 60.4])
    assert PhotoReader(tmp_path, 10_000).size(path, shot) == (800, 600)


@pytest.mark.parametrize("name", ["a.png.png", "a.png", "named.png"])
def test_masks_count_where_white_and_alpha_is_laid_over_black(name, tmp_path):
    """Beside the folder of photos under their names, or as the cameras name them."""
    pixels = noise(channels=4)
    mask = np.zeros((96, 128), np.uint8)
    pixels[:, :32, 3] = 0
    pixels[:, 32:, 3] = 255
    mask[:48] = 255
    path = saved(pixels, tmp_path / "images" / "left" / "a.png")
    saved(mask, tmp_path / "masks" / "left" / name)
    reader = PhotoReader(tmp_path, 1000, tmp_path / "images")
    shot = camera(mask="masks/left/named.png" if name == "named.png" else "")
    photo = reader.read(path, shot)
    assert not photo.image[:, :32].any() and torch.equal(
        photo.image[:, 32:], torch.from_numpy(pixels[:, 32:, :3])
    )
    assert photo.mask is not None and photo.mask[:24].all() and not photo.mask[24:].any()
    (tmp_path / "masks" / "left" / name).write_bytes(b"no mask")
    with pytest.raises(DataError, match=f"{name}: cannot be read as a mask"):
        reader.read(path, shot)
    assert reader.read(saved(noise(), tmp_path / "images" / "b.png"), camera()).mask is None


def test_a_photo_is_turned_by_exif_where_its_camera_is(tmp_path):
    exif = Image.Exif()
    exif[274] = 6
    path = saved(noise(), tmp_path / "a.png", exif=exif)
    reader = PhotoReader(tmp_path, 1000)
    pixels = torch.from_numpy(noise())
    assert torch.equal(reader.read(path, camera(48, 64)).image, pixels.rot90(-1))
    assert torch.equal(reader.read(path, camera()).image, pixels)


@pytest.mark.filterwarnings("error::PIL.Image.DecompressionBombWarning")
@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"no photo", "cannot be read as a photo"),
        (png_of(64, 48), "cannot be read as a photo"),
        (png_of(13_000, 12_000), r"cannot .* \(13000 x 12000 pixels; expected at most 150 million"),
        (png_of(20_000, 20_000), r"cannot .* \(too many pixels; expected at most 150 million"),
        (webp_of(16_383, 16_383), r"cannot .* \(16383 x 16383 pixels; expected at most 150"),
        (POSTSCRIPT, r"cannot .* \(not one of JPEG, PNG"),
    ],
)
def test_photos_that_cannot_be_read_or_are_huge_are_named(content, text, tmp_path):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(DataError, match=f"a.png: {text}"):
        PhotoReader(tmp_path, 1000).read(tmp_path / "a.png", camera())


@pytest.mark.parametrize(
    ("names", "files", "found"),
    [
        (
            ["images/a.jpg", "./images/b"],
            ["a.png", "b.JPG"],
            ["a.png", "b.JPG"],
        ),  # smaller copies, other suffixes
        (["left/1.jpg", "right/1.jpg"], ["1.jpg"], [None, None]),  # two cameras would have it
        (["1"], ["left/1.jpg", "right/1.jpg"], [None]),  # it is not known which
        (
            ["images/1.jpg"],
            ["images/1.jpg", "depths/1.png"],
            ["images/1.jpg"],
        ),  # where the file of cameras has it
        (["../../secret.png", "/etc/a.png", "", "a\0b"], ["b.png"], [None] * 4),
    ],
)
def test_each_camera_has_the_photo_of_its_name(names, files, found, tmp_path):
    for file in files:
        saved(noise(), tmp_path / file)
    frames = [{"file_path": name, "transform_matrix": torch.eye(4).tolist()} for name in names]
    (tmp_path / "transforms.json").write_text(
        json.dumps({"fl_x": 50, "w": 64, "h": 48, "frames": frames})
    )
    named = read_named_views(tmp_path / "transforms.json")
    matched = photos_of_cameras(tmp_path, photo_files(tmp_path), named)
    by_name = {
        named.names[index]: path.relative_to(tmp_path).as_posix() for index, path in matched.items()
    }
    assert [by_name.get(frame["file_path"]) for frame in frames] == found


def test_a_folder_without_photos_says_so(tmp_path):
    (tmp_path / "notes.txt").write_text("none")
    (tmp_path / ".hidden").mkdir()
    saved(noise(), tmp_path / ".hidden" / "a.png")
    with pytest.raises(DataError, match="no photo in it"):
        photo_files(tmp_path)
    with pytest.raises(DataError, match="no such folder"):
        photo_files(tmp_path / "none")
