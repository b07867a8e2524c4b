"""Rotations, camera axes and space-filling curves: what several parts compute with and none of them owns."""
