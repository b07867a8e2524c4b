"""Geometry that several parts use: rotations, camera axes, nearest neighbours, space-filling
curves."""
