"""Pictures of small scenes by every path, and drawing a scene."""

import pytest
import torch

import golden

TORCH = {"compiled": False}

PATHS = {
    "packed": TORCH,
    "dense": {"packed": False, **TORCH},
    "regions": {"memory_budget": 4000, **TORCH},
    "compiled": {},  # where the kernels were built, in float32, of at most four channels
    "compiled in regions": {"memory_budget": 4000},
}

if torch.cuda.is_available():
    PATHS["CUDA"] = {"device": "cuda"}


@pytest.mark.parametrize("options", PATHS.values(), ids=PATHS)
@pytest.mark.parametrize("dtype", golden.TOLERANCES)
@pytest.mark.parametrize("name", golden.SCENES)
def test_every_path_draws_what_the_reference_draws(name, dtype, options):
    golden.compare(
        golden.drawn(name, dtype, **options),
        golden.drawn_by_reference(name),
        *golden.TOLERANCES[dtype],
    )
