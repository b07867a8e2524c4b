"""The picture of the page on sampled views."""

from PIL import Image

from lab.sampled_views import main


def test_the_plan_and_what_cameras_see_are_drawn(tmp_path):
    main(tmp_path / "sampled.jpg")
    with Image.open(tmp_path / "sampled.jpg") as picture:
        assert picture.format == "JPEG" and picture.size == (1200, 440)
        assert len(set(picture.resize((60, 22)).getdata())) > 200, "pictures, not blanks"
