"""Text of ``--help`` after the options: examples of every command, and meanings of exit statuses."""

from __future__ import annotations

EXAMPLES: dict[str, tuple[tuple[str, str], ...]] = {
    "prune": (
        ("a tenth of the Gaussians, to room_pruned.ply", "pointsplat prune room.ply --keep 10%"),
        ("a small file for the web", "pointsplat prune room.ply --keep 20% --sh auto -o small.spz"),
        (
            "see first what would be kept",
            "pointsplat prune room.ply --keep 30% --by paper --dry-run --plot kept.png",
        ),
    ),
    "compact": (
        ("a tenth, repaired, and a page to compare", "pointsplat compact room.ply --keep 10% --html small.html"),
        ("for a page of the web", "pointsplat compact room.ply --for web"),
        ("the smallest file of at least 32 dB", "pointsplat compact room.ply --target-db 32 -o small.sog"),
        ("with the photos and their COLMAP model", "pointsplat compact room.ply --photos images --poses sparse/0"),
        ("every scene of a folder, and a gallery", "pointsplat compact rooms --keep 10% --jobs 4 --html all.html"),
    ),
    "clean": (
        ("what floats or is hidden goes, to room_clean.ply", "pointsplat clean room.ply"),
        ("a picture of what goes", "pointsplat clean room.ply --strength 0.3 --picture gone.png"),
    ),
    "lod": (
        ("three levels of detail", "pointsplat lod room.ply --levels 50% 10% 2%"),
        ("a stream with a page for the web", "pointsplat lod room.ply --stream --html -o page"),
    ),
    "tradeoff": (
        ("measure the trade, to room_tradeoff", "pointsplat tradeoff room.ply"),
        ("the smallest scene of 32 dB", "pointsplat tradeoff room.ply --target-db 32 --json"),
    ),
    "convert": (
        ("an SPZ of fewer SH bands", "pointsplat convert room.ply room.spz --sh 1"),
        ("a run, in the frame of its photos' poses", "pointsplat convert outputs/room room.ply --original-frame"),
        ("what is up, -y, turned to z", "pointsplat convert room.ply turned.spz --up=-y:z"),
    ),
    "info": (
        ("what is in a scene", "pointsplat info room.ply"),
        ("scenes side by side", "pointsplat info room.ply small.spz"),
        ("where other commands look at it from", "pointsplat info room.ply --views sheet.png"),
        ("the same for a program", "pointsplat info room.spz --json"),
    ),
    "view": (
        ("a scene in the browser", "pointsplat view room.ply"),
        ("two, with a wipe", "pointsplat view room.ply room_pruned.ply --port 8000"),
    ),
    "render": (
        ("a film", "pointsplat render room.ply -o room.mp4"),
        ("two scenes with a wipe", "pointsplat render room.ply room_pruned.ply --split wipe -o both.mp4"),
        ("one picture", "pointsplat render room.ply -o room.png --width 1280 --height 720"),
    ),
    "export": (
        ("the scene of a run", "pointsplat export outputs/room/splatfacto-cpu/RUN -o room.ply"),
        ("one scene of a trained refiner", "pointsplat export outputs/refiner --scene room2 -o room2.ply"),
    ),
    "train": (
        ("50,000 Gaussians from photos with poses", "pointsplat train my_capture --keep 50000"),
        ("sooner: fewer pixels, fewer steps", "pointsplat train my_capture --keep 50k --scale 0.5 --steps 3000"),
    ),
    "demo": (
        ("a scene to try commands with: room.ply", "pointsplat demo"),
        ("in another format", "pointsplat demo -o room.spz"),
    ),
}
"""Command lines of every command, with the purpose of each."""

STATUSES = {
    0: "done",
    1: "an error, in one line on standard error; with a traceback, a bug of ours",
    2: "a command line that is not understood",
    129: "the terminal was lost (SIGHUP)",
    130: "interrupted by Ctrl-C (SIGINT)",
    143: "asked to end (SIGTERM)",
}
"""Meanings of exit statuses."""


def after_help(args: list[str]) -> str:
    """Text to print after the help that arguments ask for; empty if they ask for none."""
    if not {"-h", "--help"} & {*args}:
        return ""
    if args[0] in EXAMPLES:
        lines = [line for what, command in EXAMPLES[args[0]] for line in (f"  # {what}", f"  {command}")]
        return "\n".join(["examples:", *lines])
    table = [f"  {status:<5}{meaning}" for status, meaning in STATUSES.items()]
    examples = "`pointsplat COMMAND --help` has examples."
    completion = "Completion in your shell: `pointsplat --tyro-write-completion bash FILE`; zsh and tcsh as well."
    return "\n".join(["exit status:", *table, "", examples, completion])
