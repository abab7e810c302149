import pytest

from gripper_force.errors import ConfigError
from gripper_force.jobs.training.recipe import RECIPES, TrainConfig, recipe


def test_recipe_of_the_paper() -> None:
    paper = recipe("shin2019")
    assert (paper.learning_rate, paper.schedule, paper.weight_decay) == (1e-4, "step", 0)
    assert (paper.epochs, paper.minutes, paper.clips, paper.windows) == (120, None, 64, "separate")
    shape = paper.network(0)
    assert (shape.window, shape.size, shape.label_scale_n, shape.hidden, shape.head) == (
        20,
        128,
        20,
        256,
        1024,
    )


def test_keys_of_a_recipe_can_be_set() -> None:
    changed = recipe("shin2019", ["preprocess.size=64", "epochs=3"])
    assert (changed.preprocess.size, changed.preprocess.reference, changed.epochs) == (64, False, 3)
    assert RECIPES["shin2019"]["preprocess"]["size"] == 128
    assert recipe("short_clips") == TrainConfig()
    with pytest.raises(ConfigError, match="no recipe 'shin'"):
        recipe("shin")


@pytest.mark.parametrize(
    ("overrides", "reason"),
    [
        (["backbone=resnet18", "preprocess.size=48"], "backbone resnet18; use a multiple of 32"),
        (["attentions=[]"], "attentions"),
        (["windows=separate"], "short_share only applies to shared windows"),
        (["short_frames=30"], "short_frames 30 is more than clip_frames 22"),
    ],
)
def test_conflicting_keys_raise(overrides: list[str], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        recipe("short_clips", overrides)
