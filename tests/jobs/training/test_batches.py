import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.training.batches import Batches
from gripper_force.jobs.training.parallel import TrainingProcess
from gripper_force.jobs.training.recipe import TrainConfig
from gripper_force.vision.batch_inference import normalise

pytestmark = pytest.mark.usefixtures("one_thread")


def test_batches_equal_the_inputs_of_a_run(clips: list[Clip], small_recipe: TrainConfig) -> None:
    plain = small_recipe.model_copy(update={"shift_px": 0, "light": 0.0, "noise": 0.0, "clips": 40})
    inputs, forces_n, valid, _ = Batches(clips, plain, TrainingProcess("cpu")).batch(0, plain.clips, 22)
    assert inputs.shape == (40, 22, 1, 16, 16)
    assert valid.all()
    frames = torch.from_numpy(np.stack([clip.frames for clip in clips]))
    images = normalise(frames, frames[:, :4], plain.preprocess).flatten(0, 1)  # (6 * 60, 1, 16, 16)
    labels = np.concatenate([clip.forces_n for clip in clips])
    for image, force_n in zip(inputs[:, -1], forces_n[:, -1], strict=True):
        same = (images - image).abs().amax((1, 2, 3)) < 1e-4
        assert force_n.item() in labels[same]


def test_frames_without_label_have_no_loss(clips: list[Clip], small_recipe: TrainConfig) -> None:
    for clip in clips:
        clip.valid[::2] = False
        clip.forces_n[::2] = 1e9
    _, forces_n, valid, _ = Batches(clips, small_recipe, TrainingProcess("cpu")).batch(
        0, small_recipe.clips, 22
    )
    assert valid[:, -1].all()
    assert not valid.all()
    assert (forces_n[valid] < 10).all()


def test_nominal_labels_use_nominal_stiffness(clips: list[Clip], small_recipe: TrainConfig) -> None:
    known = [replace(clip, stiffness=0.5 if i else math.nan) for i, clip in enumerate(clips)]
    nominal = small_recipe.model_copy(update={"labels": "nominal"})
    _, measured_n, _, _ = Batches(known, small_recipe, TrainingProcess("cpu")).batch(0, 60, 22)
    _, forces_n, _, _ = Batches(known[1:], nominal, TrainingProcess("cpu")).batch(0, 60, 22)
    assert forces_n.max() == pytest.approx(2 * measured_n.max())
    _, real_n, _, _ = Batches(known[:1], nominal, TrainingProcess("cpu")).batch(0, 60, 22)
    assert real_n.max() == measured_n.max()


def test_rare_forces_are_drawn_more_often(clips: list[Clip], small_recipe: TrainConfig) -> None:
    config = small_recipe.model_copy(update={"clips": 300, "force_share": 1.0})
    _, forces_n, _, _ = Batches(clips, config, TrainingProcess("cpu")).batch(0, config.clips, 22)
    counts = np.bincount(forces_n[:, -1].int().numpy(), minlength=8)
    assert counts.min() > 20
    none = small_recipe.model_copy(update={"clips": 300, "force_share": 0.0, "contact_share": 0.0})
    _, forces_n, _, _ = Batches(clips, none, TrainingProcess("cpu")).batch(0, none.clips, 22)
    assert (forces_n[:, -1] == 0).float().mean() > 0.15


def test_every_labelled_frame_ends_one_clip_per_pass(clips: list[Clip], small_recipe: TrainConfig) -> None:
    rng = np.random.default_rng(0)
    for clip in clips:
        clip.forces_n[:] = rng.permutation(10_000)[: len(clip.forces_n)]
        clip.valid[:7] = False
    plain = small_recipe.model_copy(update={"force_share": 0.0, "contact_share": 0.0})
    batches = Batches(clips, plain, TrainingProcess("cpu"))
    assert batches.labels == 6 * 53
    for first in (0, 53):  # of the first pass, and of the second
        steps = range(first, first + 53)
        drawn = np.concatenate([batches.batch(step, 6, 2)[1][:, -1] for step in steps])
        assert sorted(drawn) == sorted(np.concatenate([clip.forces_n[7:] for clip in clips]))


def test_processes_share_the_batch_of_one(clips: list[Clip], small_recipe: TrainConfig) -> None:
    whole = Batches(clips, small_recipe, TrainingProcess("cpu")).batch(3, 5, 6)
    shares = [Batches(clips, small_recipe, TrainingProcess("cpu", rank, 2)).batch(3, 5, 6) for rank in (0, 1)]
    for all_clips, even, odd in zip(whole, *shares, strict=True):
        torch.testing.assert_close(all_clips[::2], even, rtol=0, atol=0, equal_nan=True)
        torch.testing.assert_close(all_clips[1::2], odd, rtol=0, atol=0, equal_nan=True)


def test_separate_window_is_the_end_of_a_longer_clip(clips: list[Clip], small_recipe: TrainConfig) -> None:
    batches = Batches(clips, small_recipe.model_copy(update={"noise": 0.0}), TrainingProcess("cpu"))
    for long, short in zip(batches.batch(0, 4, 30), batches.batch(0, 4, 21), strict=True):
        torch.testing.assert_close(long[:, -21:], short, equal_nan=True)
