"""Scenes and their files: Gaussians, views, trained runs, PLY and other formats."""
