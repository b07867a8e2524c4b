"""splat-transform, as far as it can be tested without Node."""
