"""Visibility weight of each Gaussian: how much an error at it counts, from all that is known of its viewers.

Three factors: the pixels of a unit of area from the viewpoints, the share of them that is not occluded, and the traces
that photos left in the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.looking.content import positions_in_units, some_of, thinned
from pointsplat_ns.looking.sampling import PROBED, is_room
from pointsplat_ns.looking.traces import how_much_seen
from pointsplat_ns.pruning.merging.participants import Participants
from pointsplat_ns.pruning.merging.settings import MergeSettings
from pointsplat_ns.pruning.merging.viewpoints import Viewpoints, place_weights, view_weights
from pointsplat_ns.pruning.merging.visibility import count_pixels
from pointsplat_ns.views import Views


@dataclass(frozen=True, eq=False)
class Weights:
    """What is known of the viewers of each participant."""

    area: Tensor  # [n] float32, visibility weight per unit of area: factor of the cost of a pair
    visibility: Tensor  # [n] float32 in (0, 1], factor of the mass in regrouping


def visibility_weights(participants: Participants, viewpoints: Viewpoints | None, settings: MergeSettings) -> Weights:
    """Weights of the participants (n,); equal for all without viewpoints."""
    scene, members = participants.scene, participants.members
    if viewpoints is None:
        return Weights(torch.ones(len(members)), torch.ones(()).expand(len(members)))
    means = positions_in_units(scene.means[members], participants.centre, participants.size)
    if viewpoints.given:
        area = view_weights(means, viewpoints.views, settings.outside_weight, settings)
        exponent = settings.trace_exponent_given
    elif viewpoints.photos is not None:
        area = place_weights(means, *viewpoints.photos, settings)
        exponent = settings.trace_exponent_photos
    else:
        area = view_weights(means, viewpoints.views, 1.0, settings)
        room = is_room(thinned(scene, PROBED))
        exponent = settings.trace_exponent_room if room else settings.trace_exponent_object
    neighbourhood, single = _visibility_shares(participants, area, viewpoints.views, settings)
    area = area * neighbourhood
    return Weights(area * how_much_seen(scene, members) ** exponent if exponent else area, single)


def _visibility_shares(
    participants: Participants, area: Tensor, views: Views, settings: MergeSettings
) -> tuple[Tensor, Tensor]:
    """Visibility factors (n,) of the neighbourhood of each participant, and of each by itself. In a large scene, one of
    several participants along the curve is drawn for all of them."""
    scene, members = participants.scene, participants.members
    n, step = len(members), -(-len(members) // settings.occlusion_max_count)
    if step > 1:
        scene = some_of(scene, members, step)
        members, area = torch.arange(len(scene)), area[::step]
    counts = count_pixels(participants.in_units(scene), members, area, views, settings)
    shares = (counts.neighbourhood_shares(settings), counts.single_shares(settings))
    neighbourhood, single = (share.repeat_interleave(step)[:n] for share in shares)
    return neighbourhood, single
