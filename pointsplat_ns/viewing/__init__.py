"""Views of scenes: camera paths, split-screen pictures, videos, and the viewer in a browser."""
