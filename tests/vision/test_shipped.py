from pathlib import Path

from gripper_force.config import load_config
from gripper_force.jobs.evaluate import evaluate
from gripper_force.jobs.simulate import make_log, plan
from gripper_force.vision.export import export_errors
from gripper_force.vision.header import SHIPPED
from gripper_force.vision.model_files import SHIPPED_EXPORTS, exported_name, read_model, unusable


def test_shipped_network_tolerates_a_moving_background(tmp_path: Path) -> None:
    config = load_config(None, ["sim.moving_background=true"]).model_dump(mode="json")
    for one in plan("tap", 2, 903_000):
        make_log(one, tmp_path, config)
    result = evaluate(tmp_path)
    assert result.mae_n < 0.4
    assert max(errors.mae_n for errors in result.per_object.values()) < 0.7


def test_the_onnx_files_are_exports_of_the_checkpoints() -> None:
    models = {exported_name(model, ".onnx"): model for model in map(read_model, SHIPPED)}
    assert {path.name for path in SHIPPED_EXPORTS.iterdir()} == set(models)
    for name, model in models.items():
        exported = read_model(SHIPPED_EXPORTS / name)
        assert (exported.digest, exported.header) == (model.digest, model.header)
        assert export_errors(model, SHIPPED_EXPORTS / name)["largest_n"] < 1e-3


def test_a_damaged_onnx_file_of_the_package_is_not_to_be_deleted() -> None:
    model = read_model("small")
    problem = unusable(
        "ONNX Runtime", SHIPPED_EXPORTS / exported_name(model, ".onnx"), model, ValueError("it")
    )
    assert str(problem).endswith("; install gripper-force again")
