import os
import subprocess
import sys

import pytest

from gripper_force.config import Config
from gripper_force.errors import ConfigError
from gripper_force.jobs.checks import Check
from gripper_hw.sim.simulation_probe import probe
from gripper_hw.sim.world import World


def test_scene_is_rendered() -> None:
    (check,) = probe(Config.model_validate({"object": "stapler", "sim": {"detail": "coarse"}}))
    assert (check.unit, check.name, check.ok) == ("simulation", "EGL", True)
    assert check.found.startswith("renders 16x16 pixels of 'stapler'")


def test_every_timed_image_is_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    times_ns = []
    render = World.render

    def counted(world: World, side: int) -> object:
        times_ns.append(world.t_ns)
        return render(world, side)

    monkeypatch.setattr(World, "render", counted)
    list(probe(Config.model_validate({"object": "stapler", "sim": {"detail": "coarse"}})))
    assert len(set(times_ns)) == len(times_ns) > 3


def test_missing_egl_gives_advice() -> None:
    code = (
        "from gripper_force import config\nfrom gripper_force.jobs import doctor\n"
        "doctor.PROBES = {'simulation': 'gripper_hw.sim.simulation_probe'}\n"
        "print(next(doctor.doctor(config.Config())))"
    )
    env = {**os.environ, "__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert "ok=False" in done.stdout
    assert "advice='on Debian or Ubuntu: apt-get install libegl1" in done.stdout


def test_simulation_is_not_checked_without_a_simulated_camera() -> None:
    config = Config.model_validate({"camera": {"backend": "none"}})
    assert list(probe(config)) == [
        Check("simulation", "EGL", "not needed: the camera is not simulated", None)
    ]


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gripper_force.plugins.find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"camera\.backend=simulated needs mujoco.*gripper-force\[sim\]"):
        list(probe(Config()))
