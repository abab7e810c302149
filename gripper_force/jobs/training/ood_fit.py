"""Fit of a checkpoint's out-of-distribution score and of its claimed deviation, on logs not trained on."""

from base64 import urlsafe_b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CONTACT_N, Clip, check_size, load_clips, without_contact_starts
from gripper_force.jobs.known_frames import EDGES_N, fit_subspace, smooth_ratios, typical_shares
from gripper_force.jobs.training.view_fit import fit_views
from gripper_force.profiles.correction import KnownFrames
from gripper_force.profiles.object_profile import OodLimit
from gripper_force.progress import Progress, no_progress
from gripper_force.vision.batch_inference import features
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.checkpoint_writer import check_writable, replace_header
from gripper_force.vision.estimator import claimed_std_n
from gripper_force.vision.header import Header, KnownViews, OodModel, read_checkpoint
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.ood import residual_share

Floats = npt.NDArray[np.float64]

REJECTED: Final = 0.03
"""Share of the frames of left-out logs above the limit, at each force."""

MIN_LOGS: Final = 8
"""Fewer logs with contact do not show how logs differ."""

FOLDS: Final = 4
"""Parts of the logs, each scored by the subspace of the others. Each needs at least one set."""

UNKNOWN_FACTOR: Final = 4.0
"""With a larger factor between errors and claims, a network does not know the logs that its score was fitted to. The
shipped networks have 1.3 and 1.7."""


class _Seen(NamedTuple):
    """Estimates and features of the labelled frames of one log."""

    features: npt.NDArray[np.float32]  # (N, F)
    estimate_n: Floats  # (N,)
    std_n: Floats  # (N,), claimed without the score
    force_n: Floats  # (N,)


def fit_ood(
    networks: Sequence[ForceNetwork],
    header: Header,
    clips: Sequence[Clip],
    device: str = "cpu",
    progress: Progress = no_progress,
) -> OodModel | None:
    """Fits the model with the sets in four parts: each part is scored by the subspace of the others.

    Args:
        networks: The members, in evaluation mode, on ``device``.
        header: Their header; its ``ood`` is not used.
        clips: Recordings that the networks were not trained on, of the kinds of objects and scenes they know.
        device: Device of the networks.
        progress: Called after each clip.

    Returns:
        The model; None if the logs that show contact are fewer than `MIN_LOGS`, or of fewer than `FOLDS` sets.
    """
    check_size(clips, header.preprocess)
    seen = []
    sets: list[tuple[str, str]] = []  # of each log: object and set
    for clip in clips:
        forces_n, read_out = features(networks, header.preprocess, clip.frames, device)
        used = clip.labelled(header.preprocess.lead_in)
        if (clip.forces_n[used] > CONTACT_N).any():
            std_n = claimed_std_n(header, forces_n[:, used])
            force_n = clip.forces_n[used].astype(np.float64)
            seen.append(_Seen(read_out[used], forces_n[:, used].mean(0).astype(np.float64), std_n, force_n))
            sets.append((clip.object, clip.set))
        progress(f"scored {clip.name}")
    different = list(dict.fromkeys(sets))
    if len(seen) < MIN_LOGS or len(different) < FOLDS:
        return None
    # Logs of one set show the same touches: in two parts, one would be scored by the other.
    part_of = dict(zip(different, np.random.default_rng(0).permutation(len(different)) % FOLDS, strict=True))
    fold = np.array([part_of[one] for one in sets])
    shares: list[Floats] = [np.empty(0)] * len(seen)
    for part in range(FOLDS):
        subspace = _subspace([log for log, own in zip(seen, fold, strict=True) if own != part])
        for i in np.flatnonzero(fold == part):
            shares[i] = residual_share(seen[i].features, *subspace)
    estimates_n = [log.estimate_n for log in seen]
    return model_of_scores(
        KnownFrames(*_subspace(seen), _limits(shares, estimates_n)),
        shares,
        estimates_n,
        np.concatenate([(log.estimate_n - log.force_n) / log.std_n for log in seen]),
        np.concatenate([log.force_n > CONTACT_N for log in seen]),
    )


def model_of_scores(
    known: KnownFrames,
    shares: Sequence[Floats],
    estimates_n: Sequence[Floats],
    z: Floats,
    contact: npt.NDArray[np.bool_],
) -> OodModel:
    """Returns the model of known frames, with the claimed deviation from logs that were left out.

    Args:
        known: The known frames.
        shares: Shares of the residual of the frames of each log, (N,) each, by a subspace without the log.
        estimates_n: Their estimates, (N,) each.
        z: Errors of all frames over the deviation claimed without the score, (N,).
        contact: True for the frames in contact, (N,).
    """
    mean, axes, floor, limits = known
    ratio = np.concatenate([smooth_ratios(limits, *log) for log in zip(shares, estimates_n, strict=True)])
    score = ratio / np.interp(
        np.concatenate(estimates_n), [o.force_n for o in limits], [o.limit for o in limits]
    )
    used = (score <= 1) & contact
    base, growth = _std_factors(score[used], z[used])
    return OodModel(
        mean=_encoded(mean, np.float32),
        axes=_encoded(axes, np.float16),
        floor=floor,
        limits=limits,
        std_base=base,
        std_growth=growth,
    )


def add_ood(source: str | Path, model: OodModel, views: KnownViews | None, out: Path) -> None:
    """Writes a checkpoint with fitted models. The weights and the digest stay.

    Args:
        source: Path or name of the checkpoint.
        model: Model of the out-of-distribution score.
        views: Views that the network knows; None leaves those of the checkpoint.
        out: Checkpoint to write; it may be the same file.

    Raises:
        CheckpointError: The checkpoint can't be read or written.
    """
    header = read_checkpoint(source)[2]
    replace_header(source, header.model_copy(update={"ood": model, "views": views or header.views}), out)


def calibrate_network(
    logs: Sequence[Path],
    out: Path,
    source: str | Path = "default",
    *,
    workers: int = 1,
    progress: Progress = no_progress,
) -> tuple[OodModel, KnownViews | None, int]:
    """Fits a checkpoint's out-of-distribution score, known views and claimed deviation to logs, and writes it.

    Args:
        logs: Logs that the checkpoint was not trained on, of the kinds of objects and scenes it knows. Logs that
            start in contact are not used.
        out: Checkpoint to write.
        source: Path or name of the checkpoint. Its weights stay.
        workers: Processes that read the logs.
        progress: Called twice for each log.

    Returns:
        The score's model; the known views, None if the logs are of too few sets (the checkpoint then keeps its own);
        and the number of logs that start in contact.

    Raises:
        DataError: The logs that show contact are fewer than `MIN_LOGS`, or of fewer than `FOLDS` sets.
        LogError: A log can't be read.
        CheckpointError: The checkpoint can't be read or written.
    """
    check_writable(out)
    checkpoint = load_checkpoint(source)
    networks = checkpoint.force_networks  # raises for a Gaussian process, before the logs are read
    preprocess = checkpoint.header.preprocess
    loaded = load_clips(logs, preprocess, None, workers, progress)
    clips = without_contact_starts(loaded, preprocess)
    left_out = len(loaded) - len(clips)
    progress(f"left out {left_out} logs", left_out)
    model = fit_ood(networks, checkpoint.header, clips, progress=progress)
    if model is None:
        raise DataError(
            f"a score needs at least {MIN_LOGS} logs that show contact and were not trained on, of at least {FOLDS} "
            "sets; simulate or record more"
        )
    views = fit_views(clips, preprocess)
    add_ood(source, model, views, out)
    return model, views, left_out


def _limits(shares: Sequence[Floats], estimates_n: Sequence[Floats]) -> tuple[OodLimit, ...]:
    """Returns the limit of each bin of estimated force that has frames, for the frames of each log."""
    typical = typical_shares(shares, estimates_n)
    bins = np.digitize(np.concatenate(estimates_n), EDGES_N)
    ratio = np.concatenate([smooth_ratios(typical, *log) for log in zip(shares, estimates_n, strict=True)])
    return tuple(
        limit.model_copy(update={"limit": float(np.quantile(ratio[bins == number], 1 - REJECTED))})
        for limit, number in zip(typical, np.unique(bins), strict=True)
    )


def _subspace(logs: Sequence[_Seen]) -> tuple[Floats, Floats, float]:
    return fit_subspace(
        np.concatenate([log.features for log in logs]), np.concatenate([log.force_n for log in logs])
    )


def _std_factors(score: Floats, z: Floats) -> tuple[float, float]:
    """Returns base and growth of the claimed deviation's factor: maximum likelihood of normal errors."""

    def cost(log_factors: Floats) -> float:
        variance = np.square(np.exp(log_factors[0])) + np.square(np.exp(log_factors[1]) * score)
        return float((np.square(z) / variance + np.log(variance)).mean())

    base, growth = np.exp(minimize(cost, np.array([0.0, -1.0]), method="Nelder-Mead").x)
    return float(base), float(growth)


def _encoded(values: npt.NDArray[np.floating], dtype: type[np.floating]) -> bytes:
    """Returns an array as the header's text: base64 of its bytes."""
    return urlsafe_b64encode(values.astype(dtype).tobytes())
