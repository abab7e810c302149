import errno
from datetime import date
from pathlib import Path

import pytest

from gripper_force.config import load_config
from gripper_force.errors import ConfigError
from gripper_force.jobs.profile_files import check_object_place, write_object
from gripper_force.profiles.apply import read_profiles, with_object
from gripper_force.profiles.object_profile import (
    BUNDLED,
    Interval,
    LoopPlant,
    ObjectProfile,
    OodLimit,
    OutputCurve,
    find_object,
    read_object,
    user_folder,
    weights_path,
)


def profile(**keys: object) -> ObjectProfile:
    found = ObjectProfile(
        object="mug",
        date=date(2026, 1, 2),
        checkpoint="a" * 64,
        camera=load_config().rig_settings(),
        touches=4,
        frames=400,
        force_n=7.5,
        output=OutputCurve(kind="affine", estimate_n=(0.0, 8.0), force_n=(0.1, 6.5)),
        interval=Interval(coverage=0.9, base_n=0.1, share=0.03),
        ood_limits=(OodLimit(force_n=0.0, typical=0.02, limit=3.0),),
        plant=LoopPlant(
            gain=0.9, lag_ms=30, delay_ms=40, proportional=0.4, integral_s=14, phase_margin_deg=61
        ),
        before_n=0.5,
        after_n=0.06,
        weights="b" * 64,
    )
    return found.model_copy(update=keys)


def test_profile_round_trips(tmp_path: Path) -> None:
    write_object(tmp_path / "mug.yaml", profile(), b"weights")
    assert weights_path(tmp_path / "mug.yaml").read_bytes() == b"weights"
    assert read_object(tmp_path / "mug.yaml") == profile()


def test_a_learned_ratio_round_trips_and_reaches_the_controller(tmp_path: Path) -> None:
    path = tmp_path / "mug.yaml"
    write_object(path, profile(ratio=(1.4, 0.05)), b"weights")
    assert read_object(path).ratio == (1.4, 0.05)
    config = load_config(overrides={"calibration.object": str(path)})
    assert with_object(config.control, read_profiles(config)).object_ratio == (1.4, 0.05)
    own = load_config(overrides={"calibration.object": str(path), "control.object_ratio": [0.9, 0.1]})
    assert with_object(own.control, read_profiles(own)).object_ratio == (0.9, 0.1)


def test_full_disk_keeps_both_files_of_the_old_profile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "mug.yaml"
    write_object(path, profile(), b"old")
    real = Path.write_bytes

    def full(file: Path, data: bytes) -> int:
        if file.name.startswith(".mug.yaml"):
            raise OSError(errno.ENOSPC, "No space left on device")  # it names no file
        return real(file, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(ConfigError, match=r"can't write .*mug\.yaml.*: No space left on device$"):
        write_object(path, profile(touches=9), b"new")
    assert weights_path(path).read_bytes() == b"old"
    assert read_object(path).touches == 4


def test_unwritable_path_is_refused_before_calibration(tmp_path: Path) -> None:
    check_object_place(tmp_path / "new" / "mug.yaml")
    assert list((tmp_path / "new").iterdir()) == []
    with pytest.raises(ConfigError, match=r"ends in \.yaml"):
        check_object_place(tmp_path / "mug")
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="can't write"):
        check_object_place(tmp_path / "file" / "mug.yaml")
    (tmp_path / "mug.yaml").mkdir()
    with pytest.raises(ConfigError, match=r"mug\.yaml: it is a folder; name a file in it"):
        check_object_place(tmp_path / "mug.yaml")


def test_user_profiles_come_before_shipped_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with pytest.raises(ConfigError, match="no object profile 'mug'"):
        find_object("mug")
    write_object(user_folder() / "mug.yaml", profile(), b"")
    assert find_object("mug") == tmp_path / "gripper-force" / "objects" / "mug.yaml"
    with pytest.raises(ConfigError, match=r"known: .*mug"):
        find_object("cup_of_another")
    assert find_object("some/where.yaml") == Path("some/where.yaml")
    bundle = user_folder() / "mug"
    write_object(bundle / BUNDLED, profile(network="network.safetensors"), b"")
    assert find_object("mug") == find_object(str(bundle)) == bundle / BUNDLED


def test_lengths_of_the_same_gripper_may_differ_a_little() -> None:
    near = load_config(None, ["gripper.open_width_m=0.0925"]).rig_settings()
    assert profile().mismatches("a" * 64, near) == []
    far = load_config(None, ["gripper.open_width_m=0.11", "sim.view_spread=5"]).rig_settings()
    assert profile().mismatches("a" * 64, far) == [
        "gripper.open_width_m 0.092, not 0.11",
        "sim.view_spread 1.0, not 5.0",
    ]


def test_mismatches_name_network_and_settings() -> None:
    settings = load_config(None, ["camera.rate_hz=30"]).rig_settings()
    assert profile().mismatches("a" * 64, load_config().rig_settings()) == []
    assert profile().mismatches("c" * 64, settings) == [
        "network aaaaaaaaaaaa, not cccccccccccc",
        "camera.rate_hz 60.0, not 30.0",
    ]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "format: gripper-force-rig/1",
            r".* does not have the object profile format gripper-force-object/1 \(it is 'gripper-force-rig/1'",
        ),
        ("[1, 2]", "mapping"),
        ("format: gripper-force-object/1", "Field required"),
    ],
)
def test_invalid_file_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(ConfigError, match=sentence):
        read_object(tmp_path / "x.yaml")


@pytest.mark.parametrize(
    ("estimate_n", "force_n", "sentence"),
    [
        ((0.0, 1.0), (0.0, 1.0, 2.0), "the same length"),
        ((0.0, 0.0), (0.0, 1.0), "must rise"),
        ((0.0, 1.0), (1.0, 0.0), "must not fall"),
    ],
)
def test_invalid_curve_is_refused(
    estimate_n: tuple[float, ...], force_n: tuple[float, ...], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        OutputCurve(kind="monotone", estimate_n=estimate_n, force_n=force_n)
