"""Files that version 0.1 wrote are read as before."""

from pathlib import Path

import gripper_force as gf
from gripper_force.jobs.grasp import summarise
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
    summary = summarise(LOG)
    assert (summary["result"], summary["object"], summary["target_n"]) == ("held", "stapler", 2.0)


def test_an_older_request_has_the_default_of_the_new_field() -> None:
    assert {request.width_m for request in gf.LogReader(LOG).records(gf.Request)} == {0.0}


def test_an_object_profile_is_read(tmp_path: Path) -> None:
    shipped = Path(__file__).parents[1] / "calibration/gripper_calibration/objects/sponge.yaml"
    text = shipped.read_text()
    assert "\ngate: " in text  # as version 0.1 wrote it
    newer = tmp_path / "newer.yaml"
    newer.write_text(text.replace("\ngate: ", "\nood_limit: "))
    assert read_object(shipped) == read_object(newer)


def test_a_checkpoint_is_read() -> None:
    names = set(dict(load_checkpoint("default").networks[0].named_parameters()))
    assert {"blstm.forward_lstm.weight_ih_l0", "blstm.backward_linear.weight"} <= names
