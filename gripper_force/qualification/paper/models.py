"""Networks that the paper's tables compare, and their training at each scale."""

from typing import Annotated, Final, Literal

from pydantic import Field

from gripper_force.jobs.paper_protocol import Instances
from gripper_force.jobs.training.recipe import TrainConfig
from gripper_force.schema import Section, Tree
from gripper_force.vision.preprocess import Preprocess

NETS: Final[dict[str, Tree]] = {
    "plain": {"attentions": ("none",)},
    "ssam-0": {"attentions": ("ssam",), "earlier_frames": 0},
    "scam-0": {"attentions": ("scam",), "earlier_frames": 0},
    "ssam-1": {"attentions": ("ssam",)},
    "scam-1": {"attentions": ("scam",)},
    "ssam-2": {"attentions": ("ssam",), "earlier_frames": 2},
    "scam-2": {"attentions": ("scam",), "earlier_frames": 2},
    "ssam-1-gap": {"attentions": ("ssam",), "pooling": "gap"},
    "scam-1-gap": {"attentions": ("scam",), "pooling": "gap"},
    "se": {"attentions": ("se",)},
    "cbam": {"attentions": ("cbam",)},
    "resnet-plain": {"attentions": ("none",), "backbone": "resnet18"},
    "resnet-ssam-1": {"attentions": ("ssam",), "backbone": "resnet18"},
    "resnet-scam-1": {"attentions": ("scam",), "backbone": "resnet18"},
    "mobile-ssam-1": {"attentions": ("ssam",), "backbone": "mobile"},
    "mobile-scam-1": {"attentions": ("scam",), "backbone": "mobile"},
}
"""Single networks, with their differences from the recipe of the scale."""

BASELINE: Final = "baseline"
PROPOSED: Final = "proposed, ensemble"
SINGLE_FRAME: Final = "single frame, ensemble"
TWO_PLAIN: Final = "two plain networks"

MODELS: Final[dict[str, tuple[str, ...]]] = {
    BASELINE: ("plain",),
    TWO_PLAIN: ("plain", "plain"),
    "single frame, spatial": ("ssam-0",),
    "single frame, channel": ("scam-0",),
    SINGLE_FRAME: ("ssam-0", "scam-0"),
    "proposed, spatial": ("ssam-1",),
    "proposed, channel": ("scam-1",),
    PROPOSED: ("ssam-1", "scam-1"),
    "n = 2, ensemble": ("ssam-2", "scam-2"),
    "GAP, spatial": ("ssam-1-gap",),
    "GAP, channel": ("scam-1-gap",),
    "GAP, ensemble": ("ssam-1-gap", "scam-1-gap"),
    "SE": ("se",),
    "CBAM": ("cbam",),
    "ResNet, baseline": ("resnet-plain",),
    "ResNet, ensemble": ("resnet-ssam-1", "resnet-scam-1"),
    "mobile, ensemble": ("mobile-ssam-1", "mobile-scam-1"),
}
"""Models in the tables: a network, or the mean of several.

The members of an ensemble have consecutive seeds, so that two plain networks differ in their seed just as SSAM
and SCAM do.
"""


class Scale(Section):
    """Size of a reproduction.

    Attributes:
        protocol: Scale of the simulated protocol that the networks are trained on.
        instances: Instances of object and rig in the simulated sets.
        size: Side of the input in pixels.
        width: Multiplier of the backbone's channels.
        steps: Optimiser steps of each network.
        seeds: Seeds with which each network is trained.
    """

    protocol: Literal["small", "full"] = "small"
    instances: Instances = "same"
    size: Annotated[int, Field(ge=32, le=1024, multiple_of=32)] = 64
    width: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] = 0.5
    steps: Annotated[int, Field(ge=1)] = 1100
    seeds: Annotated[int, Field(ge=1, le=100)] = 3

    def recipe(self, net: str, seed: int) -> TrainConfig:
        """Recipe of one network; recipes differ only in the keys of `NETS` and the seed."""
        return TrainConfig(
            **NETS[net],
            preprocess=Preprocess(size=self.size),
            width=self.width,
            steps=self.steps,
            shift_px=1,
            light=0.1,
            noise=0.005,
            seed=seed,
        )


SCALES: Final = {
    "small": Scale(),
    "full": Scale(protocol="full", size=128, width=1.0, steps=2000),
}
