"""Training recipes: all keys, and recipes by name."""

import json
from copy import deepcopy
from typing import Annotated, Final, Literal, Self, TypeVar

from pydantic import Field, ValidationError, model_validator

from gripper_force.errors import ConfigError
from gripper_force.schema import (
    NonNegative,
    Positive,
    Section,
    Tree,
    assign,
    assign_value,
    validated,
)
from gripper_force.vision.header import (
    Attention,
    BackboneName,
    Count,
    GaussianProcessConfig,
    Header,
    NetworkConfig,
    Pooling,
    Quantity,
)
from gripper_force.vision.preprocess import Preprocess

S = TypeVar("S", bound=Section)

Share = Annotated[float, Field(ge=0, le=1)]

RECIPES: Final[dict[str, Tree]] = {
    "short_clips": {},
    "shin2019": {
        "preprocess": {"size": 128, "reference": False},
        "epochs": 120,
        "clips": 64,
        "windows": "separate",
        "short_share": 0.0,
        "learning_rate": 1e-4,
        "schedule": "step",
        "weight_decay": 0.0,
        "gradient_limit": None,
        "contact_share": 0.0,
        "force_share": 0.0,
        "shift_px": 0,
        "light": 0.0,
        "noise": 0.0,
        "precision": "float32",
    },
    "touches": {
        "steps": 300,
        "clips": 8,
        "warmup": 0.1,
        "short_share": 0.0,
        "shift_px": 1,
        "light": 0.1,
        "noise": 0.01,
        "freeze_statistics": True,
    },
    "few": {"method": "process", "preprocess": {"size": 64, "magnitude": True}},
}
"""Keys that each recipe sets; all others have `TrainConfig`'s defaults, which are ``short_clips``.

``touches`` continues a shipped network (``--init``) with a few touches of one object, as `teach` does.

``few`` fits a Gaussian process instead of training a network, for a few recordings, see `training.few`.

``shin2019`` follows section III-E of the paper. What the paper does not state: frames are standardised, as in
all recipes, and there is no augmentation, weight decay or gradient clipping.
"""


FITTED_AT_ONCE: Final = (
    "a Gaussian process is fitted to all its recordings at once; train it without --init and --replay, on a folder "
    "with all recordings"
)
"""Reason why a Gaussian process does not continue a checkpoint."""


class TrainConfig(Section):
    """A training recipe.

    Attributes:
        method: ``network``, or ``process`` for a Gaussian process, which uses no other key than ``preprocess``.
        attentions: Attention of each member of the ensemble.
        earlier_frames: Number of earlier frames n that SSAM and SCAM use.
        pooling: Pooling of SSAM and SCAM: weighted or global average.
        backbone: Backbone of all members.
        width: Multiplier of the backbone's channels.
        hidden: Units of each direction of the BLSTM.
        head: Units of the dense layer.
        preprocess: Preparation of frames.
        steps: Optimiser steps per member.
        epochs: Passes over the new recordings per member; replaces ``steps``. A pass has as many of their clips as
            they have frames with a label. Without ``contact_share`` and ``force_share`` each frame is the last of one.
            Not with ``short_share``, whose steps have more clips.
        minutes: Training time of the whole ensemble; replaces ``steps`` and ``epochs``.
        windows: ``shared``: all windows of a clip contribute to the loss, and each frame passes the backbone
            once for all of them. ``separate``: a clip is one window and its n earlier frames, with one loss.
        clips: Clips per step.
        clip_frames: Frames per clip with shared windows; those from the window's length on contribute to the
            loss.
        short_share: Share of the training, from its start, with clips of `short_frames`, and more of them at
            the same cost: the backbone learns more from many scenes than from many frames of one.
        short_frames: Frames of such a clip; the window before it is filled with copies of its first frame, as
            at the start of a run.
        learning_rate: Peak learning rate.
        schedule: ``one_cycle``: up and down along two half cosines. ``step``: divided by ten after each
            quarter of the training.
        warmup: Share of the training in which the learning rate of ``one_cycle`` rises.
        weight_decay: Weight decay of AdamW; 0 gives Adam.
        gradient_limit: Norm to which larger gradients are clipped; None for no limit.
        labels: ``measured``: forces of the load cell. ``nominal``: forces that a simulated object would have
            with exactly the nominal stiffness of its kind. Images show no more than that; the difference
            would be noise.
        indentation_weight: Weight of the squared error of the indentation, the travel of the jaws since contact
            over 20 mm, beside that of force / 20 N; 0 trains no such output.
        contact_weight: Weight of the cross-entropy of contact; 0 trains no such output.
        teacher_share: Share of a teacher's estimate (`--teacher`) in the force to learn; the rest is the label.
        freeze_statistics: Keep the batch statistics of the initial checkpoint (`--init`), which few recordings
            would replace by their own; None: true with ``--init``. False suits many scenes.
        contact_share: Share of clips that end in contact.
        force_share: Share of clips whose last frame is drawn evenly over force, because high forces are rare.
        shift_px: Largest shift of a clip.
        light: Standard deviation of the logarithm of the brightness factor and of gamma, drawn per clip.
        noise: Largest standard deviation of pixel noise, as a fraction of full scale.
        replay_share: Share of the clips that is drawn from the recordings of an earlier training, if there are any.
        validation: Share of each object's sets that is held out to measure the checkpoint's error; of the objects,
            if no object has two sets.
        seed: Seed of weights and draws.
        precision: Arithmetic of backbone and attention; all else, and all weights, are float32. ``auto``: bfloat16 on a
            device that has instructions for it, float32 on others, which would be slower with bfloat16.
        device: Device to train on; ``auto`` uses CUDA if it is available.
        compile: Compile the network; faster only after some minutes on a GPU.
    """

    method: Literal["network", "process"] = "network"
    attentions: Annotated[tuple[Attention, ...], Field(min_length=1)] = ("ssam", "scam")
    earlier_frames: Annotated[int, Field(ge=0, le=20)] = 1
    pooling: Pooling = "wap"
    backbone: BackboneName = "vgg"
    width: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] = 1.0
    hidden: Count = 256
    head: Count = 1024
    preprocess: Preprocess = Preprocess()
    steps: Annotated[int, Field(ge=1)] = 1000
    epochs: Positive | None = None
    minutes: Positive | None = None
    windows: Literal["shared", "separate"] = "shared"
    clips: Annotated[int, Field(ge=1)] = 12
    clip_frames: Annotated[int, Field(ge=1)] = 22
    short_share: Share = 0.6
    short_frames: Annotated[int, Field(ge=1)] = 4
    learning_rate: Positive = 1e-3
    schedule: Literal["one_cycle", "step"] = "one_cycle"
    warmup: Annotated[float, Field(gt=0, lt=1)] = 0.25
    weight_decay: NonNegative = 0.01
    gradient_limit: Positive | None = 1.0
    labels: Literal["measured", "nominal"] = "measured"
    indentation_weight: NonNegative = 0.0
    contact_weight: NonNegative = 0.0
    teacher_share: Share = 0.7
    freeze_statistics: bool | None = None
    contact_share: Share = 0.3
    force_share: Share = 0.2
    shift_px: Annotated[int, Field(ge=0)] = 2
    light: NonNegative = 0.2
    noise: NonNegative = 0.02
    replay_share: Annotated[float, Field(ge=0, lt=1)] = 0.5
    validation: Annotated[float, Field(gt=0, lt=1)] = 0.1
    seed: Annotated[int, Field(ge=0)] = 0
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    device: Literal["auto", "cpu", "cuda"] = "auto"
    compile: bool = False

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.method == "process" and (unused := self.model_fields_set - {"method", "preprocess"}):
            raise ValueError(
                f"a Gaussian process has no {', '.join(sorted(unused))}; leave it out, or use recipe short_clips"
            )
        try:
            self.network(0)
        except ValidationError as error:
            raise ValueError(error.errors()[0]["msg"].removeprefix("Value error, ")) from error
        if self.windows == "separate" and self.short_share:
            raise ValueError("short_share only applies to shared windows; set it to 0 for separate ones")
        if self.epochs is not None and self.short_share:
            raise ValueError(
                "epochs are not counted with short clips; set short_share to 0, or epochs to null"
            )
        if self.replayed == self.clips:
            raise ValueError(
                f"replay_share {self.replay_share} leaves none of {self.clips} clips for the new recordings; reduce it"
            )
        if self.short_share and self.short_frames > self.clip_frames:
            raise ValueError(
                f"short_frames {self.short_frames} is more than clip_frames {self.clip_frames}; reduce it"
            )
        return self

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """Outputs of the networks: force, and those with a weight."""
        indentation: tuple[Quantity, ...] = ("indentation",) if self.indentation_weight else ()
        contact: tuple[Quantity, ...] = ("contact",) if self.contact_weight else ()
        return ("force", *indentation, *contact)

    @property
    def replayed(self) -> int:
        """Clips of a step from an earlier training, if its recordings are mixed in; a step of short clips has more."""
        return round(self.replay_share * self.clips)

    def network(self, member: int) -> NetworkConfig:
        """Returns the configuration of one member."""
        attention = self.attentions[member]
        return NetworkConfig(
            attention=attention,
            earlier_frames=self.earlier_frames,
            pooling=self.pooling if attention in ("ssam", "scam") else "wap",
            backbone=self.backbone,
            size=self.preprocess.size,
            width=self.width,
            hidden=self.hidden,
            head=self.head,
            outputs=self.outputs,
        )


def section_from(section: type[S], overrides: list[str] | None, tree: Tree | None = None) -> S:
    """Builds a section that is not part of a configuration, such as a recipe.

    Args:
        section: What to build.
        overrides: Assignments ``key=value``, applied last.
        tree: Keys that differ from the defaults.

    Raises:
        ConfigError: A key or value is wrong.
    """
    tree = deepcopy(tree or {})
    for assignment in overrides or []:
        assign(tree, assignment)
    return validated(section, tree, "--set")


def recipe(name: str, overrides: list[str] | None = None) -> TrainConfig:
    """Returns a recipe of `RECIPES` with overrides.

    Args:
        name: Name of the recipe.
        overrides: Keys to set, as ``key=value``.

    Raises:
        ConfigError: The recipe does not exist, or a key or value is wrong.
    """
    if name not in RECIPES:
        raise ConfigError(f"no recipe {name!r}; use one of {', '.join(RECIPES)}")
    return section_from(TrainConfig, overrides, RECIPES[name])


def continued(config: TrainConfig, header: Header) -> TrainConfig:
    """Returns a recipe that continues a checkpoint: its networks and preprocessing are the checkpoint's.

    Args:
        config: The recipe. Keys that it sets must be as in the checkpoint.
        header: The checkpoint's header.

    Raises:
        ConfigError: The recipe sets a key to another value, or no recipe makes such a checkpoint.
    """
    if config.method == "process":
        raise ConfigError(FITTED_AT_ONCE)
    if any(isinstance(member, GaussianProcessConfig) for member in header.members):
        raise ConfigError(
            "the initial checkpoint is a Gaussian process, which training can't continue; train it again on all "
            "recordings with --recipe few, or name a network"
        )
    tree = config.model_dump(exclude_unset=True)
    differing: dict[str, tuple[object, object]] = {}
    for key, value in _network_keys(header).items():
        *parents, leaf = key.split(".")
        section: Section = config.preprocess if parents else config
        if leaf in section.model_fields_set and getattr(section, leaf) != value:
            differing[key] = getattr(section, leaf), value
        assign_value(tree, key, value)
    if differing:
        here, there = (
            ", ".join(f"{key}={_shown(values[i])}" for key, values in differing.items()) for i in (0, 1)
        )
        raise ConfigError(
            f"this recipe has {here}, but the initial checkpoint has {there}, which training can't change; "
            f"set {there}, or train without --init"
        )
    same = validated(TrainConfig, tree, "--init", "recipe")
    for member, shape in enumerate(header.members):
        own = same.network(member)
        for key in NetworkConfig.model_fields.keys() - {"outputs"}:  # `Trainer.start_from` adds new ones
            if getattr(own, key) != getattr(shape, key):
                raise ConfigError(
                    f"network {member} of the initial checkpoint has {key}={_shown(getattr(shape, key))}, but a "
                    f"recipe makes {key}={_shown(getattr(own, key))}; use a checkpoint that `train` made"
                )
    return same


def _network_keys(header: Header) -> dict[str, object]:
    """Returns the keys of a recipe that describe a checkpoint's networks and preprocessing."""
    members = [member for member in header.members if isinstance(member, NetworkConfig)]
    first = members[0]
    keys: dict[str, object] = {"attentions": tuple(member.attention for member in members)}
    keys |= {key: getattr(first, key) for key in ("earlier_frames", "backbone", "width", "hidden", "head")}
    if sequential := [member for member in members if member.sequential]:
        keys["pooling"] = sequential[0].pooling  # no other attention has a choice
    keys |= {f"preprocess.{key}": value for key, value in header.preprocess.model_dump().items()}
    return keys


def _shown(value: object) -> str:
    """Returns a value as ``--set`` accepts it."""
    return json.dumps(value, separators=(",", ":")).replace('"', "")
