"""The folder of a training, and the numbers of steps that it takes."""

import pytest

from making import small_config
from pointsplat_ns.errors import PointSplatError


@pytest.mark.parametrize("resumed", [False, True])
@pytest.mark.parametrize("number", [0, -3])
def test_no_steps_are_refused_and_leave_no_folder(number, resumed, wall_scene, wall_config, tmp_path):
    configs = [wall_config(wall_scene, tmp_path / "scene", 2), small_config(wall_scene, tmp_path / "refiner", 2)]
    for config in configs:
        config.max_num_iterations = number
        config.load_dir = tmp_path / "checkpoints" if resumed else None
        with pytest.raises(PointSplatError, match=f"--max-num-iterations {number}: expected at least 1"):
            config.save_config()
        assert not config.output_dir.exists()
