"""How a force network is trained: every key, and recipes by name."""

from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, ValidationError, model_validator

from gripper_force.errors import ConfigError
from gripper_force.schema import NonNegative, Positive, Section, section_from
from gripper_force.vision.header import Attention, BackboneName, Count, NetworkConfig, Pooling
from gripper_force.vision.preprocess import Preprocess

Share = Annotated[float, Field(ge=0, le=1)]

RECIPES: Final[dict[str, dict[str, Any]]] = {
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
}
"""What each recipe sets; the rest are `TrainConfig`'s defaults, which make ``short_clips``.

``shin2019`` is section III-E of the paper. Where that is silent: frames are standardised, as by everything
here, and there is no augmentation, weight decay or limit to the gradient.
"""


class TrainConfig(Section):
    """The recipe.

    Attributes:
        attentions: One member of the ensemble each.
        earlier_frames: n of SSAM and SCAM.
        pooling: Of SSAM and SCAM: weighted or global average pooling.
        backbone: Of all members.
        width: Multiplier of the backbone's channels.
        hidden: Units of each direction of the BLSTM.
        head: Units of the dense layer.
        preprocess: How frames are prepared.
        steps: Optimiser steps for each member.
        epochs: Passes over the training set for each member; stands in for ``steps`` where given. In a pass
            every frame with a label ends one clip.
        minutes: Time for the whole ensemble; stands in for both where given.
        windows: ``shared``: all windows of a clip carry a loss, and each frame passes the backbone once for
            all of them. ``separate``: a clip is one window and its n earlier frames, with one loss.
        clips: Clips a step.
        clip_frames: Frames a clip with shared windows; those from the window's length on carry a loss.
        short_share: Share of the training, from its start, on clips of `short_frames`, as many more as cost
            the same: what the backbone has to learn needs many scenes, not many moments of one.
        short_frames: Frames of such a clip; the window before it is copies of its first, as at a run's start.
        learning_rate: Its peak.
        schedule: ``one_cycle``: up and down along two half cosines. ``step``: a tenth after each quarter of
            the training.
        warmup: Share of the training in which the learning rate of ``one_cycle`` rises.
        weight_decay: Of AdamW; without any it is Adam.
        gradient_limit: Norm to which a larger gradient is cut; None for none.
        labels: ``measured``: the load cell's. ``nominal``: what it would have read, had a simulated object
            exactly its kind's stiffness: a look tells no more, so the rest is noise to be learnt by heart.
        contact_share: Share of clips that end in contact.
        force_share: Share of clips whose last frame is drawn evenly over force, as high forces are rare.
        shift_px: Largest shift of a clip.
        light: Standard deviation of the logarithm of gain and gamma, drawn for each clip.
        noise: Largest standard deviation of pixel noise, of full scale.
        validation: Share of each object's sets that is held out for the error the checkpoint claims.
        seed: Of weights and draws.
        precision: Of the backbone's and the attention's arithmetic; the rest and all weights are float32.
        device: Where to train; ``auto`` takes CUDA where it is there.
        compile: Whether to compile the network; pays after some minutes on a GPU.
    """

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
    contact_share: Share = 0.3
    force_share: Share = 0.2
    shift_px: Annotated[int, Field(ge=0)] = 2
    light: NonNegative = 0.2
    noise: NonNegative = 0.02
    validation: Annotated[float, Field(gt=0, lt=1)] = 0.1
    seed: Annotated[int, Field(ge=0)] = 0
    precision: Literal["float32", "bfloat16"] = "bfloat16"
    device: Literal["auto", "cpu", "cuda"] = "auto"
    compile: bool = False

    @model_validator(mode="after")
    def _fits(self) -> Self:
        try:
            self.network(0)
        except ValidationError as error:
            raise ValueError(error.errors()[0]["msg"].removeprefix("Value error, ")) from error
        if self.windows == "separate" and self.short_share:
            raise ValueError("short_share is of shared windows: set it to 0 for separate ones")
        if self.short_share and self.short_frames > self.clip_frames:
            raise ValueError(f"short_frames {self.short_frames} is more than clip_frames {self.clip_frames}")
        return self

    def network(self, member: int) -> NetworkConfig:
        """The shape of one member."""
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
        )


def recipe(name: str, overrides: list[str] | None = None) -> TrainConfig:
    """One of `RECIPES` with some keys set otherwise, as ``key=value``.

    Raises:
        ConfigError: There is no such recipe, or a key or value is wrong.
    """
    if name not in RECIPES:
        raise ConfigError(f"no recipe {name!r}; there are {', '.join(RECIPES)}")
    return section_from(TrainConfig, overrides, RECIPES[name])
