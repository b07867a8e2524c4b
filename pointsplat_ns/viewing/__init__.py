"""Looking at scenes: camera paths, pictures of two scenes in one, videos, and the viewer in a browser."""
