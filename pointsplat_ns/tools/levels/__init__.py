"""Levels of detail: smaller scenes of one scene, in a folder or as a stream."""
