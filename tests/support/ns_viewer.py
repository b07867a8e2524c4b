"""A client of nerfstudio's viewer, as its page is one: it says where its camera stands and gets
pictures."""

import io
import urllib.request
from typing import NamedTuple

import msgspec
import numpy as np
import torch
import viser.transforms as vtf
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.viewer.utils import CameraState, get_camera
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from PIL import Image
from websockets.sync.client import connect

SECONDS = 120
"""How long it waits for what shall come; a picture takes a fraction of a second."""
FIELD_OF_VIEW = 1.2
ASPECT = 4 / 3
"""Vertical, in radians, and width by height."""


class Look(NamedTuple):
    """What a client of the viewer got, and what the model draws from the same camera, (H, W, 3) in
    [0, 1]."""

    page: bytes
    picture: np.ndarray
    expected: np.ndarray

    def check(self) -> None:
        """Fail unless the page is one, and the picture what the model draws; for a viewer that
        sends PNG."""
        assert b"<html" in self.page
        assert self.picture.std() > 0.03, "a plain picture proves nothing"
        # 1/255: rounding to 8 bits, down
        assert np.abs(self.picture - self.expected).max() <= 1 / 255 + 1e-6


def look(viewer: Viewer, pose: np.ndarray) -> Look:
    """Open the viewer's page, connect as it does, and wait for the first picture."""
    place = f"127.0.0.1:{viewer.viser_server.get_port()}"
    with urllib.request.urlopen(f"http://{place}/", timeout=SECONDS) as response:
        page = response.read()
    turn = vtf.SO3.from_matrix(pose[:3, :3]) @ vtf.SO3.from_x_radians(np.pi)
    camera = {
        "wxyz": turn.wxyz.tolist(),
        "position": (pose[:3, 3] * VISER_NERFSTUDIO_SCALE_RATIO).tolist(),
    }
    camera |= {
        "fov": FIELD_OF_VIEW,
        "aspect": ASPECT,
        "look_at": [0.0, 0.0, 0.0],
        "up_direction": [0.0, 0.0, 1.0],
    }
    with connect(f"ws://{place}", max_size=None, open_timeout=SECONDS) as socket:
        socket.send(msgspec.msgpack.encode({"type": "ViewerCameraMessage", **camera}))
        picture = None
        while picture is None:
            for message in msgspec.msgpack.decode(socket.recv(timeout=SECONDS)):
                if message["type"] == "BackgroundImageMessage":
                    picture = np.asarray(Image.open(io.BytesIO(message["rgb_bytes"]))) / 255
    height, width = picture.shape[:2]
    state = CameraState(FIELD_OF_VIEW, ASPECT, torch.from_numpy(pose[:3]), CameraType.PERSPECTIVE)
    model = viewer.get_model()
    with viewer.train_lock:
        training = model.training
        model.eval()
        drawn = model.get_outputs_for_camera(get_camera(state, height, width))["rgb"]
        model.train(training)
    return Look(page, picture, drawn.detach().numpy())
