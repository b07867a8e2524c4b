"""Text of ``--help`` after the options: examples of every command, and meanings of exit
statuses."""

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
        ("what floats or is hidden goes, to room_clean.ply", "pointsplat clean room.ply"),
        ("a picture of what goes", "pointsplat clean room.ply --strength 0.3 --picture gone.png"),
    ),
    "lod": (
        ("three levels of detail", "pointsplat lod room.ply --levels 50% 10% 2%"),
        ("a stream for viewers on the web", "pointsplat lod room.ply --stream -o page"),
    ),
    "tradeoff": (("measure the trade, to room_tradeoff", "pointsplat tradeoff room.ply"),),
    "convert": (
        ("an SPZ of fewer SH bands", "pointsplat convert room.ply room.spz --sh 1"),
        ("what is up, -y, turned to z", "pointsplat convert room.ply turned.spz --up=-y:z"),
    ),
    "info": (
        ("what is in a scene", "pointsplat info room.ply"),
        ("where other commands look at it from", "pointsplat info room.ply --views sheet.png"),
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
"""Command lines of every command, with the purpose of each."""


def after_help(args: list[str]) -> str:
    """Text to print after the help that arguments ask for; empty if they ask for none."""
    if not {"-h", "--help"} & {*args}:
        return ""
    if args[0] in EXAMPLES:
        lines = [
            line for what, command in EXAMPLES[args[0]] for line in (f"  # {what}", f"  {command}")
        ]
        return "\n".join(["examples:", *lines])
    return """exit status:
  0    done
  1    an error, in one line on standard error; with a traceback, a bug of ours
  2    a command line that is not understood
  129  the terminal was lost (SIGHUP)
  130  interrupted by Ctrl-C (SIGINT)
  143  asked to end (SIGTERM)

`pointsplat COMMAND --help` has examples.
Completion in your shell: `pointsplat --tyro-write-completion bash FILE`; zsh and tcsh as well."""
