"""Seconds and memory: of the rasterizer, the refiner, training steps, whole commands; and what
threads do to them."""
