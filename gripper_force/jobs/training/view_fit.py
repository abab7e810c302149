"""Fit of the views before a contact that a network knows."""

from base64 import urlsafe_b64encode
from collections.abc import Sequence
from typing import Final

import numpy as np

from gripper_force.jobs.dataset import Clip
from gripper_force.vision.header import KnownViews
from gripper_force.vision.known_views import Floats, describe_view
from gripper_force.vision.ood import distance2
from gripper_force.vision.preprocess import Preprocess, mean_image

MIN_VIEWS: Final = 33
"""Fewer views do not show a limit that few known ones exceed."""

_REJECTED: Final = 0.02
"""Share of the left-out views above the limit. Of new known ones fewer are, because no view is left out then."""

_DIMENSIONS: Final = 48
"""Dimensions of the subspace. 32 to 96 tell the objects of the paper from the kinds for training about as well."""

_FOLDS: Final = 4
"""Parts of the views, each compared with those of the others."""


def fit_views(clips: Sequence[Clip], preprocess: Preprocess) -> KnownViews | None:
    """Fits the known views to the reference frames of recordings, one of each set.

    Args:
        clips: Recordings of objects and views that the network knows. They may be those of its training.
        preprocess: Preparation of the network's frames.

    Returns:
        The model; None without reference frames, or if there are fewer than `MIN_VIEWS` sets.
    """
    first = {(clip.object, clip.set): clip for clip in reversed(clips)}
    if not preprocess.reference or len(first) < MIN_VIEWS:
        return None
    references = [mean_image(clip.frames[: preprocess.reference_frames]) for clip in first.values()]
    views = np.stack([describe_view(reference) for reference in references])
    fold = np.random.default_rng(0).permutation(len(views)) % _FOLDS
    distances = []
    for part in range(_FOLDS):
        mean, axes = _subspace(views[fold != part])
        distances.append(distance2(views[fold == part] - mean, axes))
    mean, axes = _subspace(views)
    return KnownViews(
        mean=urlsafe_b64encode(mean.astype(np.float32).tobytes()),
        axes=urlsafe_b64encode(axes.astype(np.float16).tobytes()),
        limit=max(float(np.quantile(np.concatenate(distances), 1 - _REJECTED)), 1e-6),
    )


def _subspace(views: Floats) -> tuple[Floats, Floats]:
    mean = views.mean(0)
    return mean, np.linalg.svd(views - mean, full_matrices=False)[2][:_DIMENSIONS].T
