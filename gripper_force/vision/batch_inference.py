"""Inference on whole recordings in batches, on any device. Equals streaming frame by frame."""

from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import chain, islice
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from gripper_force.types import Gray
from gripper_force.vision.checkpoint import Checkpoint, Member, load_checkpoint
from gripper_force.vision.engines import Precision
from gripper_force.vision.network import ForceNetwork, LastStepBlstm, lstm_cell
from gripper_force.vision.preprocess import DIFFERENCE_GAIN, FLAT_STD, Preprocess

BATCH = {"cpu": 32, "cuda": 256}
"""Frames that pass the backbone together. On a CPU, the maps of a few frames stay in its cache, and the process
reuses their memory. Larger maps go back to the system after each batch, which then takes a third longer."""

CHUNK = 256
"""Frames whose windows are read together; limits memory."""


@lru_cache(maxsize=2)
def kept_checkpoint(source: str | Path, digest: str) -> Checkpoint:
    """Loads a checkpoint once for all logs of a process; a changed file has another ``digest`` and is loaded again."""
    return load_checkpoint(source)


def normalise(frames: Tensor, leading: Tensor, preprocess: Preprocess) -> Tensor:
    """Prepares the frames of recordings as `preprocess.Normaliser` does.

    Args:
        frames: Gray levels, (B, T, S, S), uint8 or float32.
        leading: First frames of each recording, which show no contact, (B, R, S, S).
        preprocess: Settings; ``R`` is ``reference_frames``.

    Returns:
        The network's input, (B, T, 1, S, S) float32.
    """
    inputs = _standardise(frames)
    if preprocess.reference:
        inputs = DIFFERENCE_GAIN * (inputs - _standardise(leading).mean(1, keepdim=True))
    if preprocess.magnitude:
        inputs = inputs.abs()
    return inputs[:, :, None]


def _standardise(frames: Tensor) -> Tensor:
    frames = frames.float()
    std, mean = torch.std_mean(frames, dim=(-2, -1), correction=0, keepdim=True)
    return (frames - mean) / std.clamp_min(FLAT_STD)


def predict(
    networks: Sequence[Member], preprocess: Preprocess, frames: Gray, device: str = "cpu"
) -> npt.NDArray[np.float32]:
    """Estimates the force for every frame of one recording.

    Args:
        networks: Members of the ensemble, in evaluation mode, on ``device``.
        preprocess: Preparation that the networks were trained with.
        frames: The recording, cropped and resized, (T, S, S) uint8.
        device: Device of the networks.

    Returns:
        Each member's forces in N, (M, T).
    """
    return features(networks, preprocess, frames, device)[0]


@torch.inference_mode()
def features(
    networks: Sequence[Member], preprocess: Preprocess, frames: Gray, device: str = "cpu"
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Estimates the force for every frame, and returns the inputs of the members' last layers too.

    Arguments are those of `predict`.

    Returns:
        Each member's forces in N, (M, T), and the members' concatenated features, (T, F).
    """
    forces_n, read_out = zip(*stream_features(networks, preprocess, frames, device), strict=True)
    return np.concatenate(forces_n, axis=1), np.concatenate(read_out)


@torch.inference_mode()
def stream_features(
    networks: Sequence[Member],
    preprocess: Preprocess,
    frames: Iterable[Gray],
    device: str = "cpu",
    precision: Precision = "float32",
) -> Iterator[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]:
    """Yields `features` of the next `CHUNK` frames or the last ones, and keeps no others.

    Args:
        networks: As for `predict`.
        preprocess: As for `predict`.
        frames: As for `predict`; they may come from an iterator.
        device: As for `predict`.
        precision: Arithmetic of the backbone and attention of a network with windows; all else is float32.
    """
    streams = [_NetworkStream(network, precision) for network in networks]
    for batch in _normalised(_batches(frames, torch.device(device)), preprocess):
        for stream in streams:
            stream.push(batch)
        if streams[0].pending_frames >= CHUNK:
            yield _read(streams)
    if streams[0].pending_frames:
        yield _read(streams)


def _batches(frames: Iterable[Gray], device: torch.device) -> Iterator[Tensor]:
    """Yields the next frames of a recording, (1, N, S, S), with `BATCH` of them but in the last."""
    remaining = iter(frames)
    while part := list(islice(remaining, BATCH[device.type])):
        yield torch.from_numpy(np.stack(part))[None].to(device)


def _normalised(batches: Iterator[Tensor], preprocess: Preprocess) -> Iterator[Tensor]:
    """Yields batches of a recording's frames, (1, N, S, S), prepared for the networks."""
    leading_batches: list[Tensor] = []
    while (
        sum(batch.shape[1] for batch in leading_batches) < preprocess.reference_frames
        and (batch := next(batches, None)) is not None
    ):
        leading_batches.append(batch)
    if leading_batches:
        leading = torch.cat(leading_batches, dim=1)[:, : preprocess.reference_frames]
        for batch in chain(leading_batches, batches):
            yield normalise(batch, leading, preprocess)


def _read(streams: "Sequence[_NetworkStream]") -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    forces, features = zip(*(stream.read() for stream in streams), strict=True)
    return torch.stack(forces).cpu().numpy(), torch.cat(features, dim=1).cpu().numpy()


class _NetworkStream:
    """Runs a network on the batches of a stream, and keeps only what the next ones need."""

    def __init__(self, network: Member, precision: Precision) -> None:
        self._network = network
        self._uses_bfloat16 = precision == "bfloat16"
        self._parts: list[Tensor] = []
        self._maps: Tensor | None = None
        self._earlier: Tensor | None = None
        self.pending_frames = 0

    def push(self, batch: Tensor) -> None:
        """Runs the network up to its averages, or a network without windows as a whole."""
        if isinstance(self._network, ForceNetwork):
            with torch.autocast(batch.device.type, torch.bfloat16, enabled=self._uses_bfloat16):
                part, self._maps = self._network.pooled(batch, self._maps)
        else:
            part = self._network.features(batch)
        self._parts.append(part[0].float())
        self.pending_frames += batch.shape[1]

    def read(self) -> tuple[Tensor, Tensor]:
        """Returns forces, (K,), and the inputs of the last layer, (K, head), of the frames since the last call."""
        features = torch.cat(self._parts)
        self._parts, self.pending_frames = [], 0
        if isinstance(self._network, ForceNetwork):
            count = self._network.config.window - 1
            earlier = features[:1].expand(count, -1) if self._earlier is None else self._earlier
            pooled = torch.cat([earlier, features])
            self._earlier = pooled[len(pooled) - count :]
            features = torch.tanh(self._network.dense(_over_windows(self._network.blstm, pooled, count + 1)))
        return self._network.force_n(features), features


def _over_windows(blstm: LastStepBlstm, vectors: Tensor, window: int) -> Tensor:
    """Returns the output of ``blstm`` for each window of a sequence, (T - window + 1, 2*hidden).

    The products with the input weights are computed once for each vector, not for each window that contains it.

    Args:
        blstm: The layer.
        vectors: The sequence, (T, F).
        window: Length of the windows.
    """
    input_weight, hidden_weight, input_bias, hidden_bias = blstm.forward_lstm.all_weights[0]
    from_input = F.linear(vectors, input_weight, input_bias + hidden_bias)  # (T, 4*hidden)
    count = len(vectors) - window + 1
    hidden = cell = vectors.new_zeros(count, blstm.forward_lstm.hidden_size)
    for k in range(window):
        gates = torch.addmm(from_input[k : k + count], hidden, hidden_weight.t())  # (count, 4*hidden)
        hidden, cell = lstm_cell(gates, cell)
    return torch.cat([hidden, blstm.backward_output(vectors[window - 1 :])], dim=1)
