"""Files that version 0.1 wrote are read as before."""

from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import yaml
from safetensors.numpy import save

import gripper_force as gf
from gripper_force.jobs.grasp import summarise_grasp
from gripper_force.profiles.correction import load_correction
from gripper_force.profiles.object_profile import read_object
from gripper_force.vision.checkpoint import load_checkpoint

LOG = Path(__file__).parent / "data" / "version_0_1.mcap"
"""``grasp --object stapler --target-n 2 --seed 7 --feedback current --set camera.backend=none`` by version 0.1."""


def test_a_log_is_replayed_by_todays_controller() -> None:
    reader = gf.LogReader(LOG)
    assert reader.metadata["version gripper-force"] == "0.1.0"
    result = gf.replay(LOG)
    assert not result.identical  # the speed limit and the approach came later
    assert "version 0.1.0 wrote the log" in result.note
    assert 0 < result.changed["goal_current_a"] < 0.1
    assert result.changed["fused_n"] < 0.5


def test_a_log_is_summarised() -> None:
    summary = summarise_grasp(LOG)
    assert (summary["result"], summary["object"], summary["target_n"]) == ("held", "stapler", 2.0)


def test_an_older_request_has_the_default_of_the_new_field() -> None:
    assert {request.width_m for request in gf.LogReader(LOG).records(gf.Request)} == {0.0}


@pytest.mark.parametrize("key", ["gate", "ood_limit"])
def test_an_object_profile_is_read_without_its_earlier_limit(tmp_path: Path, key: str) -> None:
    """The correction and the interval count as before; the limit was of another score."""
    head, rest = {"head": np.zeros(3, np.float32), "offset": np.ones(1, np.float32)}, np.ones(3, np.float32)
    weights = save({**head, "mean": rest, "axes": rest[:, None], "spread": rest[:1]})
    tree = {
        "format": "gripper-force-object/1",
        "object": "mug",
        "date": "2026-01-02",
        "checkpoint": "a" * 64,
        "camera": {},
        "touches": 3,
        "frames": 30,
        "force_n": 6.0,
        "output": {"kind": "affine", "estimate_n": [0.0, 2.0], "force_n": [0.0, 3.0]},
        "interval": {"coverage": 0.9, "base_n": 0.3, "share": 0.1},
        key: 0.002,
        "before_n": 0.5,
        "weights": sha256(weights).hexdigest(),
    }
    path = tmp_path / "mug.yaml"
    path.write_text(yaml.safe_dump(tree))
    path.with_suffix(".safetensors").write_bytes(weights)
    correction = load_correction(path, read_object(path), 3)
    assert correction.known is None
    assert correction.force_n([2.0], rest[None]).tolist() == [4.0]


def test_a_checkpoint_is_read() -> None:
    names = set(dict(load_checkpoint("default").networks[0].named_parameters()))
    assert {"blstm.forward_lstm.weight_ih_l0", "blstm.backward_linear.weight"} <= names
