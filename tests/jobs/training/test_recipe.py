import pytest

from gripper_force.errors import ConfigError
from gripper_force.jobs.training.recipe import RECIPES, TrainConfig, continued, recipe, section_from
from gripper_force.vision.header import Header, NetworkConfig, Residual, read_checkpoint
from gripper_force.vision.preprocess import Preprocess


def test_the_recipe_shin2019_has_the_values_of_the_paper() -> None:
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
        (["epochs=3"], "epochs are not counted with short clips"),
        (["clips=2", "replay_share=0.9"], "replay_share 0.9 leaves none of 2 clips for the new recordings"),
        (["short_frames=30"], "short_frames 30 is more than clip_frames 22"),
    ],
)
def test_conflicting_keys_raise(overrides: list[str], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        recipe("short_clips", overrides)


def header(*members: NetworkConfig, preprocess: Preprocess) -> Header:
    residual = Residual(force_n=0, std_n=1)
    return Header(members=members, preprocess=preprocess, residuals=(residual,), data_digest="", metrics={})


@pytest.mark.parametrize("name", ["default", "small"])
def test_shipped_checkpoint_continues_with_its_own_keys(name: str) -> None:
    shipped = read_checkpoint(name)[2]
    config = continued(recipe("short_clips", ["steps=7", "noise=0.005"]), shipped)
    assert tuple(config.network(i) for i in range(len(config.attentions))) == shipped.members
    assert config.preprocess == shipped.preprocess
    assert (config.steps, config.noise) == (7, 0.005)
    assert continued(config, shipped) == config


def test_every_key_of_a_checkpoint_is_taken() -> None:
    own = recipe(
        "short_clips",
        [
            "attentions=[none,scam]",
            "earlier_frames=3",
            "pooling=gap",
            "backbone=resnet18",
            "width=0.5",
            "hidden=8",
            "head=9",
            "preprocess={size: 32, reference_frames: 6, magnitude: true}",
        ],
    )
    made = header(own.network(0), own.network(1), preprocess=own.preprocess)
    assert continued(recipe("short_clips"), made) == own
    assert continued(own, made) == own


@pytest.mark.parametrize(
    ("name", "overrides", "here", "there"),
    [
        ("short_clips", ["width=0.5"], "width=0.5", "width=1.0"),
        ("short_clips", ["preprocess.size=96"], "preprocess.size=96", "preprocess.size=64"),
        ("short_clips", ["attentions=[ssam]"], "attentions=[ssam]", "attentions=[ssam,scam]"),
        (
            "shin2019",
            [],
            "preprocess.size=128, preprocess.reference=false",
            "preprocess.size=64, preprocess.reference=true",
        ),
    ],
)
def test_key_that_differs_from_the_checkpoint_is_named(
    name: str, overrides: list[str], here: str, there: str
) -> None:
    shipped = read_checkpoint("default")[2]
    with pytest.raises(ConfigError) as refused:
        continued(recipe(name, overrides), shipped)
    assert f"this recipe has {here}, but the initial checkpoint has {there}," in str(refused.value)
    remedy = str(refused.value).split("; set ")[1].split(", or")[0]
    assert continued(recipe(name, [*overrides, *remedy.split(", ")]), shipped)


def test_checkpoint_that_no_recipe_makes_raises() -> None:
    made = header(NetworkConfig(size=32, window=9), preprocess=Preprocess(size=32))
    with pytest.raises(ConfigError, match=r"network 0 .* has window=9, but a recipe makes window=20"):
        continued(TrainConfig(), made)


def test_a_section_stands_alone() -> None:
    assert section_from(TrainConfig, ["steps=3"], {"steps": 2}) == TrainConfig(steps=3)
    with pytest.raises(ConfigError, match=r"unknown configuration key 'stepps'.*steps"):
        section_from(TrainConfig, ["stepps=3"])
