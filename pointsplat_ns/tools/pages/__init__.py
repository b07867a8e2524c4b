"""Self-contained HTML pages that open offline, films, and the viewer with its web server."""
