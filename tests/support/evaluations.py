"""What ns-eval writes for a pointsplat run, made up, and ways of spoiling it."""

from collections.abc import Iterator

WRONG: list = [None, [], {}, "text", [1], 10**400, {"psnr": "high"}]
"""Values that none of an evaluation's entries has."""


def evaluation(lpips: float | None = 0.25) -> dict:
    """Two scenes, one of them never seen in training."""

    def row(psnr: float, count: int) -> dict:
        return {"psnr": psnr, "ssim": 0.9, "lpips": lpips, "gaussians": count, "megabytes": count * 236e-6, "fps": 12.0}

    rows = {"dense": row(30.0, 1000), "pruned": row(20.0, 100), "refined": row(25.0, 100)}
    return {
        "results": {
            "settings": {"keep": 0.1, "by": "paper", "size": "tiny"},
            "average": rows,
            "average_unseen": rows,
            "average_seen": rows,
            "scenes": {
                "a": {"seen_in_training": True, "views": 3, **rows},
                "b": {"seen_in_training": False, "views": 3, **rows},
            },
        }
    }


def places(node: dict, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The path to every entry of nested dictionaries."""
    for key, value in node.items():
        yield (*path, key)
        if isinstance(value, dict):
            yield from places(value, (*path, key))
