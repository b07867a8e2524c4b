"""Pages with scenes to fly through, in a browser."""

import base64
import io

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import pointsplat_ns as ps
from browser import waited
from pointsplat_ns.tools.pages.flight import FlightFrame


def until(browser, condition: str) -> None:
    """Wait until a script's expression is true."""
    waited(lambda: browser.execute_script(f"return {condition}"), condition)


def settle(browser) -> None:
    """Wait until the picture does not change any more."""
    until(browser, "flight.still")


def message(browser) -> str:
    """What is written in place of a picture; empty if nothing is."""
    return browser.execute_script(
        "return flight.part.message.hidden ? '' : flight.part.message.textContent"
    )


def shrink(browser, width: int = 192) -> None:
    """Give the picture a width in pixels: drawing takes long without a GPU."""
    browser.execute_script("flight.part.stage.style.width = `${arguments[0]}px`", width)
    until(browser, f"flight.canvas.width == {width}")
    settle(browser)


def picture(browser) -> Tensor:
    """The picture (H, W, 3) in [0, 1], once it has settled."""
    settle(browser)
    uri = browser.execute_script("flight.paint(); return flight.canvas.toDataURL('image/png')")
    pixels = Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2])))
    return torch.from_numpy(np.asarray(pixels.convert("RGB")).copy()).float() / 255


def view_on(stage: FlightFrame, index: int, image: Tensor) -> ps.View:
    """A view of a stage, in its units, whose picture is as large as an image of this size holds."""
    height, width = image.shape[:2]
    view = stage.views[index]
    focal = float(view.K[0, 0]) * min(width / view.width, height / view.height)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return ps.View(
        view.viewmat.float(),
        K,
        width,
        height,
        view.background,
        view.rasterize_mode,
        view.near_plane,
    )


def camera(browser) -> dict[str, list[float]]:
    """Where the camera is and how it is turned."""
    return browser.execute_script("return flight.camera.state")
