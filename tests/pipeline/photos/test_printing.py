"""Photos with poses print as one line, not as their pixels."""

from making import ball
from pointsplat_ns.pipeline.photos.examples import render_of
from room_views import orbit
