"""Levels of detail: smaller versions of a scene, as a folder, stream, tiles or paged file."""
