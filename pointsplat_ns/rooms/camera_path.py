"""Camera paths through a room, as of a person with a camera: clear of furniture, and with all of the room in view."""

import math

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.rooms.room import Room

CLEARANCE = 0.30  # metres kept from walls and furniture
CELL = 0.08  # metres, grid on which free space is searched
_LOWEST, _HIGHEST = 1.05, 1.65  # metres, heights of the camera


STYLES = ("rounds", "outward", "stops")
"""How people capture rooms: two rounds that look across the room, then to both sides; two rounds along the walls that
look at them; or from a few places, turning on each."""

_STOPS = 6  # places of the style "stops"


def capture_path(room: Room, frames: int, seed: int, style: str = "rounds") -> Tensor:
    """Camera poses on a walk through a room, in one of the :data:`STYLES`.

    Height and pitch vary on the way. Every position keeps at least :data:`CLEARANCE` from all surfaces.

    Args:
        room: the room.
        frames: number of poses, F.
        seed: decides the start of the walk, its direction and the phases of height and pitch.
        style: one of :data:`STYLES`.

    Returns:
        (F, 4, 4) float32 camera-to-world, OpenCV axes, z of the world up, metres.

    Raises:
        DataError: if there is no such style, or no free place in the room.

    Example:
        >>> from pointsplat_ns.rooms import make_room
        >>> tuple(capture_path(make_room(seed=3), frames=5, seed=3).shape)
        (5, 4, 4)
    """
    if style not in STYLES:
        raise DataError(f"no capture style is called {style!r}; expected one of {', '.join(STYLES)}")
    rng = np.random.default_rng([seed, 21])
    width, depth, height = room.spec.size
    top = min(_HIGHEST, height - 0.6)
    free, xs, ys = _free_cells(room, top)
    share = np.linspace(0, 1, frames, endpoint=False)
    turn = 1.0 if rng.random() < 0.5 else -1.0
    angle = rng.uniform(0, 2 * math.pi) + turn * share * 4 * math.pi  # two rounds
    route = _route(free, xs, ys, angle)
    heights = (_LOWEST + top) / 2 + (top - _LOWEST) / 2 * np.sin(2 * math.pi * (3 * share + rng.random()))
    middle = np.array([xs[free.any(0)].mean(), ys[free.any(1)].mean()])
    # Across the room on the first round; swinging to both sides on the second, to see into the corners.
    swing = 0.2 + 0.7 * _smoothstep((share - 0.4) / 0.2)
    gaze = np.unwrap(np.arctan2(middle[1] - route[:, 1], middle[0] - route[:, 0]))
    gaze = _eased(gaze, frames / 40) + swing * np.sin(2 * math.pi * 3 * share)
    if style == "outward":
        gaze = gaze + math.pi
    elif style == "stops":
        at = np.floor(share * _STOPS)
        # Rounding may put the last place behind the last frame.
        route = route[np.minimum(np.searchsorted(share, at / _STOPS), frames - 1)]
        gaze = turn * 2 * math.pi * (share * _STOPS - at) + at
    pitch = -0.22 + 0.24 * np.sin(2 * math.pi * (5 * share + rng.random()))
    positions = np.concatenate([route, heights[:, None]], axis=1)
    return torch.stack([_look(p, g, t) for p, g, t in zip(positions, gaze, pitch, strict=True)])


def clearance(room: Room, points: Tensor) -> Tensor:
    """Distance in metres from points (M, 3) to the nearest wall or furniture's bounding box: (M,)."""
    shell = room.spec.primitives
    walls = (shell.half[0] - (points - shell.center[0]).abs()).amin(dim=-1)
    return torch.minimum(walls, shell.distance(points))


def _free_cells(room: Room, top: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """bool (Y, X) cells of the largest connected free area, and the cells' coordinates."""
    from scipy import ndimage

    width, depth, _ = room.spec.size
    xs = np.arange(-width / 2 + CELL / 2, width / 2, CELL)
    ys = np.arange(-depth / 2 + CELL / 2, depth / 2, CELL)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    free = np.ones(len(grid), dtype=bool)
    # The additional 6 cm allow for heights between those tested and positions between cells.
    for z in np.arange(_LOWEST, top + 0.099, 0.1):
        points = torch.tensor(np.concatenate([grid, np.full((len(grid), 1), z)], axis=1), dtype=torch.float32)
        free &= (clearance(room, points) > CLEARANCE + 0.06).numpy()
    labels, count = ndimage.label(free.reshape(len(ys), len(xs)))
    if count == 0:
        raise DataError(f"room seed {room.spec.seed}: furniture leaves no free space for a camera; choose another seed")
    sizes = ndimage.sum_labels(np.ones_like(labels), labels, np.arange(1, count + 1))
    return labels == 1 + int(np.argmax(sizes)), xs, ys


def _route(free: np.ndarray, xs: np.ndarray, ys: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """(F, 2) free positions round the middle of the free area, evenly spaced, without jumps.

    Corner points at several angles are joined by shortest paths over free cells, which are then
    resampled evenly and smoothed as far as they stay free.
    """
    rows, columns = np.nonzero(free)
    cells = np.stack([xs[columns], ys[rows]], axis=1)
    middle = np.array([xs[free.any(0)].mean(), ys[free.any(1)].mean()])
    offset = cells - middle
    bearing, radius = np.arctan2(offset[:, 1], offset[:, 0]), np.hypot(offset[:, 0], offset[:, 1])
    stops: list[int] = []
    for target in np.linspace(angle[0], angle[-1], 17):
        apart = np.abs((bearing - target + math.pi) % (2 * math.pi) - math.pi)
        near = apart < 0.35
        # A sector wholly taken by furniture is skipped: the way round it is found between its neighbours.
        if near.any():
            share = 0.85 if len(stops) < 8 else 0.55
            wanted = share * radius[near].max()
            stops.append(int(np.flatnonzero(near)[np.argmin(np.abs(radius[near] - wanted) + apart[near])]))
    walk = _walk(cells, stops)
    length = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(walk, axis=0).T))])
    fine = np.linspace(0, length[-1], 16 * len(angle))
    path = np.stack([np.interp(fine, length, walk[:, k]) for k in (0, 1)], axis=1)
    for _ in range(200):
        smooth = path.copy()
        smooth[2:-2] = (path[:-4] + path[1:-3] + path[2:-2] + path[3:-1] + path[4:]) / 5
        column = np.clip(np.round((smooth[:, 0] - xs[0]) / CELL).astype(int), 0, len(xs) - 1)
        row = np.clip(np.round((smooth[:, 1] - ys[0]) / CELL).astype(int), 0, len(ys) - 1)
        path = np.where(free[row, column][:, None], smooth, path)
    length = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    even = np.linspace(0, length[-1], len(angle))
    return np.stack([np.interp(even, length, path[:, k]) for k in (0, 1)], axis=1)


def _walk(cells: np.ndarray, stops: list[int]) -> np.ndarray:
    """Shortest path over neighbouring cells through all stops in turn: (S, 2) positions."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import cKDTree

    pairs = cKDTree(cells).query_pairs(CELL * 1.5, output_type="ndarray")
    steps = np.hypot(*(cells[pairs[:, 0]] - cells[pairs[:, 1]]).T)
    graph = csr_matrix((steps, (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    walk = [stops[0]]
    for start, end in zip(stops, stops[1:], strict=False):
        _, before = dijkstra(graph, directed=False, indices=end, return_predecessors=True)
        here = start
        while here != end:
            here = int(before[here])
            walk.append(here)
    return cells[walk]


def _eased(values: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian smoothing over ``sigma`` frames, against sudden turns where the path passes close to the middle."""
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(values, sigma, mode="nearest")


def _smoothstep(t: np.ndarray) -> np.ndarray:
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


def _look(position: np.ndarray, yaw: float, pitch: float) -> Tensor:
    """Camera-to-world (4, 4), OpenCV axes, level horizon."""
    forward = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
    right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(forward, right), forward, position
    return torch.from_numpy(pose).float()
