"""What a scene is, and how it is read and written: Gaussians, views, PLY, runs, other formats."""
