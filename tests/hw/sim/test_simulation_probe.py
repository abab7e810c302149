import pytest

from gripper_force.config import Config
from gripper_force.errors import ConfigError, SimulationError
from gripper_force.jobs import doctor
from gripper_force.jobs.checks import Check
from gripper_hw.sim import world
from gripper_hw.sim.engine import NO_EGL
from gripper_hw.sim.simulation_probe import probe
from gripper_hw.sim.world import World

CHEAP = {"object": "stapler", "sim": {"detail": "coarse"}}


def test_scene_is_rendered() -> None:
    (check,) = probe(Config.model_validate(CHEAP))
    assert (check.unit, check.name, check.ok) == ("simulation", "EGL", True)
    assert check.found.startswith("renders 16x16 pixels of 'stapler'")


def test_every_timed_image_is_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    times_ns = []
    render = World.render

    def counted(world: World, side: int) -> object:
        times_ns.append(world.t_ns)
        return render(world, side)

    monkeypatch.setattr(World, "render", counted)
    list(probe(Config.model_validate(CHEAP)))
    assert len(set(times_ns)) == len(times_ns) > 3


def test_missing_egl_gives_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise SimulationError(NO_EGL)

    monkeypatch.setattr(world, "new_renderer", refuse)
    monkeypatch.setattr(doctor, "PROBES", {"simulation": "gripper_hw.sim.simulation_probe"})
    check = next(doctor.doctor(Config.model_validate(CHEAP)))
    assert check.ok is False
    assert check.advice.startswith("on Debian or Ubuntu: apt-get install libegl1")


def test_simulation_is_not_checked_without_a_simulated_camera() -> None:
    config = Config.model_validate({"camera": {"backend": "none"}})
    assert list(probe(config)) == [
        Check("simulation", "EGL", "not needed: the camera is not simulated", None)
    ]


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gripper_force.plugins.find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"camera\.backend=simulated needs mujoco.*gripper-force\[sim\]"):
        list(probe(Config()))
