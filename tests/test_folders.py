from pathlib import Path

import pytest

from gripper_force.errors import ConfigError
from gripper_force.profiles.object_profile import user_folder
from gripper_force.vision.model_files import cache_folder


def test_a_user_without_a_home_names_the_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(user: int) -> None:
        raise KeyError(user)

    monkeypatch.setattr("pwd.getpwuid", unknown)
    for name in ("HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigError, match="no home folder; set XDG_CACHE_HOME to a folder"):
        cache_folder()
    with pytest.raises(ConfigError, match="no home folder; set XDG_DATA_HOME to a folder"):
        user_folder()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "gripper-force"
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_folder() == tmp_path / ".local/share/gripper-force/objects"
