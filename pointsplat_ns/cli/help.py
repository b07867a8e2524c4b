"""Text of ``--help`` after the options: examples of every command, and exit statuses."""

from __future__ import annotations

EXAMPLES: dict[str, tuple[tuple[str, str], ...]] = {
    "prune": (
        ("a tenth of the Gaussians, to room_pruned.ply", "pointsplat prune room.ply --keep 10%"),
    ),
    "compact": (
        (
            "a tenth, repaired, and a page to compare",
            "pointsplat compact room.ply --keep 10% --html small.html",
        ),
        (
            "with the photos and their COLMAP model",
            "pointsplat compact room.ply --photos images --poses sparse/0",
        ),
        (
            "every scene of a folder, and a gallery",
            "pointsplat compact rooms --keep 10% --jobs 4 --html all.html",
        ),
    ),
    "clean": (
        ("without floaters and hidden Gaussians", "pointsplat clean room.ply"),
        (
            "a picture of the removed Gaussians",
            "pointsplat clean room.ply --strength 0.3 --picture gone.png",
        ),
    ),
    "lod": (
        ("three levels of detail", "pointsplat lod room.ply --levels 50% 10% 2%"),
        ("a stream for web viewers", "pointsplat lod room.ply --stream -o page"),
    ),
    "tradeoff": (("measure the tradeoff, to room_tradeoff", "pointsplat tradeoff room.ply"),),
    "convert": (
        ("an SPZ with fewer SH bands", "pointsplat convert room.ply room.spz --sh 1"),
        ("rotated, from -y up to z up", "pointsplat convert room.ply turned.spz --up=-y:z"),
    ),
    "info": (
        ("figures of a scene", "pointsplat info room.ply"),
        ("the views of other commands", "pointsplat info room.ply --views sheet.png"),
    ),
    "view": (
        ("a scene in the browser", "pointsplat view room.ply"),
        ("two, with a wipe", "pointsplat view room.ply room_pruned.ply --port 8000"),
    ),
    "render": (
        ("a film", "pointsplat render room.ply -o room.mp4"),
        ("two scenes side by side", "pointsplat render room.ply room_pruned.ply -o both.mp4"),
    ),
    "export": (
        ("the scene of a run", "pointsplat export outputs/room/splatfacto-cpu/RUN -o room.ply"),
    ),
    "demo": (("a scene to try commands with: room.ply", "pointsplat demo"),),
}
"""Example command lines of every command, with their purposes."""


def after_help(args: list[str]) -> str:
    """Text to print after the help; empty if the arguments do not request help."""
    if not {"-h", "--help"} & {*args}:
        return ""
    if args[0] in EXAMPLES:
        lines = [
            line
            for purpose, command in EXAMPLES[args[0]]
            for line in (f"  # {purpose}", f"  {command}")
        ]
        return "\n".join(["examples:", *lines])
    return """exit status:
  0    done
  1    an error, in one line on standard error; a traceback means a bug in pointsplat 2    an
  invalid command line 129  the terminal was lost (SIGHUP) 130  interrupted by Ctrl-C (SIGINT) 143
  terminated (SIGTERM)

`pointsplat COMMAND --help` has examples.
Completion in your shell: `pointsplat --tyro-write-completion bash FILE`; zsh and tcsh as well."""
