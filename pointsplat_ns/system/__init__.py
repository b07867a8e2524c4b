"""Progress bars and memory settings."""
