from pathlib import Path

import pytest

from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs import object_gain
from gripper_force.jobs.object_gain import gain_of, learned_ratio, save_gain
from gripper_force.jobs.profile_files import write_object
from gripper_force.profiles.object_profile import find_object, read_object, weights_path
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import FusedForce


def test_a_log_tells_what_its_grasp_has_shown(fused_log: Path) -> None:
    ratio = learned_ratio(fused_log)
    last = list(LogReader(fused_log).records(FusedForce))[-1]
    if last.object_gain == 0:  # too few frames
        assert ratio is None
        return
    found = gain_of(ratio, torque_constant_std=0.06)
    assert found is not None
    assert found.gain == pytest.approx(last.object_gain)
    assert found.std == pytest.approx(last.object_gain_std)


def test_a_gain_is_saved_beside_the_correction(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = Path(__file__).parents[1] / "data"
    monkeypatch.setattr(object_gain, "learned_ratio", lambda path, _: (1.6, 0.05))
    monkeypatch.setattr(object_gain, "_torque_constant_std", lambda path, _: 0.06)
    saved = save_gain("sponge", [log, log], tmp_path / "mine.yaml")
    assert saved.object_gain == pytest.approx(1.6, rel=0.03)
    before, after = read_object(find_object("sponge")), read_object(tmp_path / "mine.yaml")
    assert after.ratio == pytest.approx((1.6, 0.05 / 2**0.5))
    assert after.model_copy(update={"ratio": None}) == before
    assert weights_path(tmp_path / "mine.yaml").exists()


def test_the_network_of_a_bundle_goes_with_the_profile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_gain, "learned_ratio", lambda path, _: (1.6, 0.05))
    monkeypatch.setattr(object_gain, "_torque_constant_std", lambda path, _: 0.06)
    source = find_object("sponge")
    bundle = tmp_path / "mug" / "profile.yaml"
    bundle.parent.mkdir()
    write_object(
        bundle,
        read_object(source).model_copy(update={"network": "network.safetensors"}),
        weights_path(source).read_bytes(),
    )
    (bundle.parent / "network.safetensors").write_bytes(b"weights")
    save_gain(str(bundle.parent), [tmp_path], tmp_path / "mine.yaml")
    saved = read_object(tmp_path / "mine.yaml")
    assert saved.network is not None
    assert (tmp_path / saved.network).read_bytes() == b"weights"
    assert save_gain(str(bundle.parent), [tmp_path]).profile == bundle
    assert read_object(bundle).network == "network.safetensors"
    for missing in (bundle.with_name("network.safetensors"), weights_path(bundle)):
        missing.unlink()
        with pytest.raises(ConfigError, match=rf"can't read {missing}, which belongs to .*: No such file"):
            save_gain(str(bundle.parent), [tmp_path], tmp_path / "other.yaml")
    assert not list(tmp_path.glob("other*"))


@pytest.mark.parametrize("uncertain", [[], [(0.5, 0.9)], [(2.0, 0.9), (0.5, 0.9)]])
def test_logs_of_two_objects_contradict_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uncertain: list[tuple[float, float]]
) -> None:
    ratios = iter([(0.6, 0.03), *uncertain, (1.6, 0.03)])
    monkeypatch.setattr(object_gain, "learned_ratio", lambda path, _: next(ratios))
    with pytest.raises(DataError, match=r"0\.60 times the visual force in one, and 1\.60 times in another"):
        save_gain("sponge", [tmp_path] * (2 + len(uncertain)), tmp_path / "mine.yaml")
    assert not list(tmp_path.iterdir())


def test_a_profile_does_not_replace_a_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_gain, "learned_ratio", lambda path, _: (1.6, 0.05))
    monkeypatch.setattr(object_gain, "_torque_constant_std", lambda path, _: 0.06)
    network = tmp_path / "mug.safetensors"
    network.write_bytes(b"a network")
    with pytest.raises(ConfigError, match=r"would replace .*mug\.safetensors, which belongs to no profile"):
        save_gain("sponge", [tmp_path], tmp_path / "mug.yaml")
    with pytest.raises(ConfigError, match=r"name a file that ends in \.yaml"):
        save_gain("sponge", [tmp_path], network)
    assert network.read_bytes() == b"a network"


@pytest.mark.parametrize(("ratio", "words"), [(None, "no log holds a grasp"), ((9.0, 0.05), "is not saved")])
def test_nothing_is_saved_without_a_plausible_gain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ratio: tuple[float, float] | None, words: str
) -> None:
    monkeypatch.setattr(object_gain, "learned_ratio", lambda path, _: ratio)
    monkeypatch.setattr(object_gain, "_torque_constant_std", lambda path, _: 0.06)
    with pytest.raises(DataError, match=words):
        save_gain("sponge", [tmp_path], tmp_path / "mine.yaml")
    assert not list(tmp_path.iterdir())
