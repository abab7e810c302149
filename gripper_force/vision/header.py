"""What a checkpoint says about itself, readable without PyTorch: shapes, preparation, errors."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, ValidationError, model_validator

from gripper_force.errors import CheckpointError
from gripper_force.schema import Finite, NonNegative, Positive, Section
from gripper_force.vision.preprocess import Preprocess

Attention = Literal["none", "ssam", "scam", "se", "cbam"]
BackboneName = Literal["vgg", "resnet18", "mobile"]
Pooling = Literal["wap", "gap"]
"""How SSAM squeezes channels and SCAM positions: averages with learned weights, or plain ones (table 5)."""

STRIDES: Final[dict[BackboneName, int]] = {"vgg": 16, "resnet18": 32, "mobile": 16}
"""Pixels of a frame for one position of each backbone's maps."""

Count = Annotated[int, Field(ge=1, le=100_000)]


class NetworkConfig(Section):
    """The shape of one network.

    Attributes:
        attention: SSAM, SCAM, none (the paper's baseline), or SE or CBAM for comparison.
        earlier_frames: n, the frames before the newest that SSAM and SCAM see; the others see none.
        pooling: How SSAM and SCAM squeeze: weighted or global average pooling.
        reduction: r of the perceptron; the paper gives none, this is that of SE and CBAM.
        backbone: The paper's VGG-like network, its ResNet with 18 layers, or a small one for slow computers.
        size: Side of the input in pixels.
        width: Multiplier of the backbone's channels.
        window: Frames the BLSTM sees.
        hidden: Units of each direction of the BLSTM.
        head: Units of the dense layer.
        label_scale_n: The last layer's output 1 means this force.
    """

    attention: Attention = "none"
    earlier_frames: Annotated[int, Field(ge=0, le=20)] = 1
    pooling: Pooling = "wap"
    reduction: Count = 16
    backbone: BackboneName = "vgg"
    size: Annotated[int, Field(ge=16, le=1024)] = 128
    width: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] = 1.0
    window: Annotated[int, Field(ge=1, le=1000)] = 20
    hidden: Count = 256
    head: Count = 1024
    label_scale_n: Positive = 20.0

    @model_validator(mode="after")
    def _fits(self) -> Self:
        stride = STRIDES[self.backbone]
        if self.size % stride:
            raise ValueError(
                f"size {self.size} does not suit the backbone {self.backbone}: take a multiple of {stride}"
            )
        if self.pooling == "gap" and not self.sequential:
            raise ValueError(
                f"pooling gap is a choice of ssam and scam: with the attention {self.attention} leave it out"
            )
        return self

    @property
    def sequential(self) -> bool:
        """Whether attention may see earlier frames."""
        return self.attention in ("ssam", "scam")

    @property
    def maps_kept(self) -> int:
        """Earlier frames whose maps a stream keeps."""
        return self.earlier_frames if self.sequential else 0

    @property
    def context(self) -> int:
        """Earlier frames that one estimate depends on."""
        return self.window - 1 + self.maps_kept


EXPORTED: Final = {".xml": "openvino", ".onnx": "onnxruntime"}
"""What a checkpoint can be exported to, by ending, and the engine that runs it."""

KEY: Final = "gripper_force"
"""Where an exported file's description is: its ``header``, and the checkpoint's ``digest``."""

FORMAT: Final = "gripper-force-network/1"
"""Key of the header in the file's metadata: the only one, as safetensors keeps no order of keys."""

SHIPPED: Final = {name: Path(__file__).with_name(f"{name}.safetensors") for name in ("default", "small")}
"""The checkpoints that come with the package."""


RESIDUAL_HALF_N: Final = 0.5
"""A residual speaks for estimates as far off as this, either way."""


class Residual(Section):
    """How far off the ensemble was on validation data where it said about ``force_n``."""

    force_n: Finite
    std_n: NonNegative


class Header(Section):
    """What a checkpoint says about itself.

    Attributes:
        members: Shapes of the networks whose mean is the estimate.
        preprocess: How frames are prepared for them.
        residuals: Error by estimated force, measured on validation data, by rising force.
        data_digest: SHA-256 of the training set.
        metrics: Figures on the validation data, such as ``mae_n``.
    """

    members: tuple[NetworkConfig, ...]
    preprocess: Preprocess
    residuals: tuple[Residual, ...]
    data_digest: str
    metrics: dict[str, float]

    @model_validator(mode="after")
    def _fits(self) -> "Header":
        if not self.members or not self.residuals:
            raise ValueError("an ensemble has at least one member and one residual")
        if any(member.size != self.preprocess.size for member in self.members):
            raise ValueError("preprocess.size and the networks' size must agree")
        return self


@dataclass(frozen=True, slots=True)
class Model:
    """A file that holds an ensemble, and what it says about itself.

    Attributes:
        path: The file.
        header: What it says.
        digest: SHA-256 of the checkpoint: of the file itself, or of the one that it was exported from.
    """

    path: Path
    header: Header
    digest: str


def read_checkpoint(source: str | Path) -> tuple[Path, bytes, Header]:
    """Reads a checkpoint's file, and its header.

    Args:
        source: A path, or ``default`` or ``small`` for one that is shipped.

    Raises:
        CheckpointError: The file is missing, damaged, or of another network.
    """
    path = SHIPPED.get(str(source), Path(source))
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}; train one with `gripper-force train`")
    if path.suffix in EXPORTED:
        raise CheckpointError(f"{path} was exported; this needs the checkpoint that it was made of")
    try:
        data = path.read_bytes()
        metadata = _metadata(data)
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise CheckpointError(f"{path} is damaged or no safetensors file: {error}") from error
    if FORMAT not in metadata:
        raise CheckpointError(f"{path} is not a {FORMAT} file; train one with `gripper-force train`")
    return path, data, header_from(metadata[FORMAT], path)


def header_from(text: str, path: Path) -> Header:
    """Reads a header's JSON. Raises `CheckpointError` that names ``path``."""
    try:
        return Header.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise CheckpointError(f"the header of {path} is wrong at {key!r}: {first['msg']}") from error


def exported_metadata(model: Model) -> dict[str, str]:
    """Returns the metadata of a file exported from a model."""
    return {"header": model.header.model_dump_json(), "digest": model.digest}


def digest_of(data: bytes) -> str:
    """SHA-256 of a checkpoint's file."""
    return hashlib.sha256(data).hexdigest()


def _metadata(data: bytes) -> dict[str, str]:
    """What a safetensors file says about itself: a length in 8 bytes, then JSON.

    Its own `safe_open` tells as well, but leaks 7 kB each time (in 0.8), which a day of grasps would feel.
    """
    length = int.from_bytes(data[:8], "little")
    return dict(json.loads(data[8 : 8 + length]).get("__metadata__") or {})
