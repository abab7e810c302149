"""Header of a checkpoint: shapes of the networks, preparation of frames, errors. Read without PyTorch."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal, Self

from pydantic import Base64UrlBytes, Field, ValidationError, model_validator

from gripper_force.errors import CheckpointError, ConfigError
from gripper_force.profiles.object_profile import OodLimit
from gripper_force.schema import Finite, NonNegative, Positive, Section, Tree, differences
from gripper_force.vision.preprocess import Preprocess

Attention = Literal["none", "ssam", "scam", "se", "cbam"]
BackboneName = Literal["vgg", "resnet18", "mobile"]
Pooling = Literal["wap", "gap"]
"""Pooling of SSAM over channels and of SCAM over positions: weighted or global average (table 5)."""

STRIDES: Final[dict[BackboneName, int]] = {"vgg": 16, "resnet18": 32, "mobile": 16}
"""Ratio of the side of a frame to the side of each backbone's feature maps."""

Quantity = Literal["force", "indentation", "contact"]
"""Output of a network: force, travel of the jaws since contact, log-odds of contact."""

INDENTATION_SCALE_M: Final = 0.02
"""Travel of the jaws since contact at output 1."""

Count = Annotated[int, Field(ge=1, le=100_000)]


class NetworkConfig(Section):
    """Shape of one network.

    Attributes:
        attention: SSAM, SCAM, none (the paper's baseline), or SE or CBAM for comparison.
        earlier_frames: n, the number of frames before the newest that SSAM and SCAM use; others use none.
        pooling: Pooling of SSAM and SCAM: weighted (WAP) or global average pooling (GAP).
        reduction: Reduction ratio r of the perceptron. The paper gives none; this is that of SE and CBAM.
        backbone: The paper's VGG-like network, its ResNet with 18 layers, or a small one for slow computers.
        size: Side of the input in pixels.
        width: Multiplier of the backbone's channels.
        window: Length of the BLSTM's input sequence in frames.
        hidden: Units of each direction of the BLSTM.
        head: Units of the dense layer.
        label_scale_n: Force at output 1 of the last layer.
        outputs: Outputs of the last layer. A run reads the first, the force.
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
    outputs: tuple[Quantity, ...] = ("force",)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.outputs[:1] != ("force",) or len(set(self.outputs)) < len(self.outputs):
            raise ValueError(f"outputs are {self.outputs}; use each at most once, and force first")
        stride = STRIDES[self.backbone]
        if self.size % stride:
            raise ValueError(
                f"size {self.size} does not fit the backbone {self.backbone}; use a multiple of {stride}"
            )
        if self.pooling == "gap" and not self.sequential:
            raise ValueError(
                f"pooling gap needs the attention ssam or scam, not {self.attention}; leave pooling out"
            )
        return self

    @property
    def sequential(self) -> bool:
        """True if the attention can use earlier frames."""
        return self.attention in ("ssam", "scam")

    @property
    def maps_kept(self) -> int:
        """Number of earlier frames whose maps a stream keeps."""
        return self.earlier_frames if self.sequential else 0

    @property
    def context(self) -> int:
        """Number of earlier frames that an estimate depends on."""
        return self.window - 1 + self.maps_kept


class GaussianProcessConfig(Section):
    """Shape of a Gaussian process on single frames, see `gaussian_process`.

    Attributes:
        size: Side of the input in pixels.
        grid: Side of the averaged frame.
        head: Number of principal components.
        points: Number of training frames that it keeps.
        length: Length scale of its kernel, in standard deviations of the first component.
        label_scale_n: Scale of the forces, as of a network.
        attention: No attention.
        context: Number of earlier frames that an estimate depends on: none.
    """

    attention: ClassVar[Attention] = "none"
    context: ClassVar[int] = 0
    size: Annotated[int, Field(ge=16, le=1024)]
    grid: Annotated[int, Field(ge=1, le=128)]
    head: Count
    points: Count
    length: Positive
    label_scale_n: Positive = 20.0

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.size % self.grid:
            raise ValueError(f"size {self.size} is not a multiple of {self.grid}; use preprocess.size=64")
        return self


EXPORTED: Final = {".xml": "openvino", ".onnx": "onnxruntime"}
"""Suffixes of exported files, and the engine that runs each."""

KEY: Final = "gripper_force"
"""Name in an exported file's metadata under which ``header`` and the checkpoint's ``digest`` are stored."""

FORMAT: Final = "gripper-force-network/1"
"""Key of the header in a checkpoint's metadata. It is the only key, as safetensors keeps no order of keys."""

SHIPPED: Final = {name: Path(__file__).with_name(f"{name}.safetensors") for name in ("default", "small")}
"""Shipped checkpoints by name."""

RESIDUAL_HALF_N: Final = 0.5
"""Half-width of the range of estimates that a residual holds for."""


class Residual(Section):
    """Error of the ensemble on validation data at estimates within `RESIDUAL_HALF_N` of ``force_n``."""

    force_n: Finite
    std_n: NonNegative


class OodModel(Section):
    """Model of the features of known frames, for the out-of-distribution score (see `gripper_force.vision.ood`).

    Attributes:
        mean: Mean of the features without contact, (F,) float32.
        axes: Orthonormal basis of the subspace near which the features lie, (F, R) float16.
        floor: Squared distance from the mean that is added to a frame's.
        limits: Limits, in order of rising force.
        std_base: Factor of the claimed standard deviation at score 0.
        std_growth: Growth of that factor with the score, added as the root of the sum of squares.
    """

    mean: Base64UrlBytes
    axes: Base64UrlBytes
    floor: Positive
    limits: Annotated[tuple[OodLimit, ...], Field(min_length=1)]
    std_base: Positive
    std_growth: NonNegative


VIEW_LENGTH: Final = 648
"""Numbers that describe a view, see `gripper_force.vision.known_views`."""


class KnownViews(Section):
    """Model of the views before a contact that a network knows (see `gripper_force.vision.known_views`).

    Attributes:
        mean: Mean description, (`VIEW_LENGTH`,) float32.
        axes: Orthonormal basis of the subspace near which descriptions lie, (`VIEW_LENGTH`, R) float16.
        limit: Largest squared distance from the subspace.
    """

    mean: Base64UrlBytes
    axes: Base64UrlBytes
    limit: Positive

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if len(self.mean) != 4 * VIEW_LENGTH or not self.axes or len(self.axes) % (2 * VIEW_LENGTH):
            raise ValueError(f"views.mean and views.axes do not have {VIEW_LENGTH} rows")
        return self


class Header(Section):
    """Metadata of a checkpoint.

    Attributes:
        members: Shapes of the networks, or of the Gaussian process, whose mean is the estimate.
        preprocess: Preparation of frames.
        residuals: Error by estimated force, measured on validation data, in order of rising force.
        data_digest: SHA-256 of the training set.
        metrics: Metrics on the validation data, such as ``mae_n``; ``constant_mae_n`` is that of the mean force
            of the training data, for comparison.
        ood: Model for the out-of-distribution score; None in checkpoints of earlier versions.
        views: Views before a contact that the network knows; None if too few were compared.
        test_digest: SHA-256 of the forces that the residuals and metrics were measured on, if it is not the
            training's own validation data. Metrics of two checkpoints compare if it is the same.
        identity: SHA-256 of the file before its header was changed; see `digest_of`.
        trained_on: Number of ``rigs`` in the training set, and the settings of the first; None if unknown.
    """

    members: tuple[NetworkConfig | GaussianProcessConfig, ...]
    preprocess: Preprocess
    residuals: tuple[Residual, ...]
    data_digest: str
    metrics: dict[str, float]
    ood: OodModel | None = None
    views: KnownViews | None = None
    test_digest: str = ""
    identity: str = ""
    trained_on: Tree | None = None

    @model_validator(mode="after")
    def _fits(self) -> "Header":
        if not self.members or not self.residuals:
            raise ValueError("an ensemble needs at least one member and one residual")
        if any(member.size != self.preprocess.size for member in self.members):
            raise ValueError("preprocess.size and the size of every member must be equal")
        if self.ood is not None:
            features = sum(member.head for member in self.members)
            if len(self.ood.mean) != 4 * features or not self.ood.axes or len(self.ood.axes) % (2 * features):
                raise ValueError(f"ood.mean and ood.axes do not have {features} rows, one for each feature")
        return self

    def mismatches(self, rig: Tree) -> list[str]:
        """Returns the differences between the one rig of the training set and a run's settings, as text."""
        training_rig = self.trained_on or {}
        return differences(training_rig, rig) if training_rig.get("rigs") == 1 else []


@dataclass(frozen=True, slots=True)
class Model:
    """File of an ensemble, and its header.

    Attributes:
        path: The file.
        header: Its header.
        digest: Digest of the checkpoint (see `digest_of`): the file itself, or the one that it was exported from.
    """

    path: Path
    header: Header
    digest: str


def check_not_exported(model: Model) -> None:
    """Raises `ConfigError` if the model's file was exported, and so only runs in another engine."""
    if model.path.suffix in EXPORTED:
        raise ConfigError(
            f"{model.path} was exported for another engine; set vision.engine={EXPORTED[model.path.suffix]}, "
            "or set vision.checkpoint to the checkpoint that it was exported from"
        )


def read_checkpoint(source: str | Path) -> tuple[Path, bytes, Header]:
    """Reads a checkpoint.

    Args:
        source: A path, or ``default`` or ``small`` for a shipped checkpoint.

    Returns:
        The file's path, its content, and the header.

    Raises:
        CheckpointError: The file is missing, damaged, or of another network.
    """
    path = SHIPPED.get(str(source), Path(source))
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}; train one with `gripper-force train`")
    if path.suffix in EXPORTED:
        raise CheckpointError(f"{path} is an exported file; name the checkpoint that it was exported from")
    try:
        data = path.read_bytes()
        metadata = _metadata(data)
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise CheckpointError(
            f"{path} is damaged or not a safetensors file: {error}; copy or train it again"
        ) from error
    if FORMAT not in metadata:
        raise CheckpointError(f"{path} is not a {FORMAT} file; train one with `gripper-force train`")
    return path, data, header_from(metadata[FORMAT], path)


def header_from(json_text: str, path: Path) -> Header:
    """Reads a header's JSON. Raises `CheckpointError` that names ``path``."""
    try:
        return Header.model_validate_json(json_text)
    except ValidationError as error:
        problem = error.errors()[0]
        key = ".".join(str(part) for part in problem["loc"])
        raise CheckpointError(
            f"the header of {path} is invalid at {key!r}: {problem['msg']}; train the network again"
        ) from error


def digest_of(data: bytes, header: Header) -> str:
    """Returns the digest by which object profiles know a checkpoint.

    It is the SHA-256 of the file as the training wrote it. A changed header keeps it, because the estimates
    that a profile corrects stay the same.
    """
    return header.identity or hashlib.sha256(data).hexdigest()


def _metadata(data: bytes) -> dict[str, str]:
    """Returns the metadata of a safetensors file: a length in 8 bytes, then JSON.

    `safetensors.safe_open` would return it too, but leaks 7 kB per call (version 0.8), which adds up in a
    process that runs for a day.
    """
    length = int.from_bytes(data[:8], "little")
    return dict(json.loads(data[8 : 8 + length]).get("__metadata__") or {})
