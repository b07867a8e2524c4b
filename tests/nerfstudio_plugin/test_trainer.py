"""The folder of a training."""

import pytest

from pointsplat_ns.errors import SceneError
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config


@pytest.mark.parametrize("method", [splatfacto_cpu_config, pointsplat_config])
def test_a_folder_that_cannot_be_made_is_one_error(method, tmp_path):
    (tmp_path / "file").touch()
    config = method()
    config.output_dir, config.experiment_name, config.timestamp = tmp_path / "file", "room", "2026-01-01_120000"
    with pytest.raises(SceneError, match="file/room.*config.yml: cannot be written"):
        config.save_config()
