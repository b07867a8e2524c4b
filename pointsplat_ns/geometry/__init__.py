"""Geometry shared by several parts: rotations, camera axes, neighbours, space-filling curves."""
