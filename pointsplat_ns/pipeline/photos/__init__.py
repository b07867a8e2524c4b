"""Photos and poses that belong to a scene."""
