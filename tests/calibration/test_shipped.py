from pathlib import Path

import pytest

from gripper_force.config import load_config
from gripper_force.jobs.grasp import PAPER_OBJECTS
from gripper_force.profiles.apply import read_correction, read_profiles
from gripper_force.profiles.object_profile import find_object, read_object
from gripper_force.vision.checkpoint import load_checkpoint


@pytest.mark.parametrize("name", PAPER_OBJECTS)
def test_shipped_profiles_match_the_shipped_network_and_the_default_camera(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert read_object(find_object(name)).object == name
    config = load_config(None, [f"object={name}", "calibration.object=own"])
    correction = read_correction(config, read_profiles(config), load_checkpoint())
    assert correction is not None
    assert correction.mismatches == ()
    assert correction.profile.force_n > 8
