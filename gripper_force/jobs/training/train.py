"""Training of an ensemble and of its checkpoint.

The diversity of scenes limits this task, not the number of labels. So a step of the recipe ``short_clips``
draws short clips from many recordings instead of long ones from a few.
"""

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs import metrics
from gripper_force.jobs.dataset import Clip, check_size, digest, label_mask, split_by
from gripper_force.jobs.report.plots import draw_training
from gripper_force.jobs.training import few
from gripper_force.jobs.training.batches import Batches, Replay
from gripper_force.jobs.training.few import PROGRESS_STEPS as PROGRESS_STEPS
from gripper_force.jobs.training.ood_fit import FOLDS, MIN_LOGS, add_ood, fit_ood
from gripper_force.jobs.training.parallel import TrainingProcess, join_training_processes
from gripper_force.jobs.training.recipe import FITTED_AT_ONCE, continued
from gripper_force.jobs.training.recipe import TrainConfig as TrainConfig
from gripper_force.jobs.training.stated_errors import errors, labelled_estimates, residuals
from gripper_force.jobs.training.trainer import Trainer
from gripper_force.jobs.training.view_fit import fit_views
from gripper_force.progress import Progress, no_progress
from gripper_force.schema import Tree
from gripper_force.vision.checkpoint import Checkpoint, Member, load_checkpoint
from gripper_force.vision.checkpoint_writer import check_writable, save_checkpoint
from gripper_force.vision.header import Header, read_checkpoint
from gripper_force.vision.network import ForceNetwork

STATE_EVERY_S: Final = 60.0
"""Time between two saved states: an interrupted training loses no more than this."""

MIN_STEPS: Final = 300
"""Fewer steps give a warning. A complete schedule of this length has about 1.6 times the error of a long training."""


def train(
    config: TrainConfig,
    clips: Sequence[Clip],
    out: Path,
    *,
    validation_clips: Sequence[Clip] | None = None,
    init: Checkpoint | None = None,
    teacher: Checkpoint | None = None,
    replay_clips: Sequence[Clip] = (),
    resume: bool = False,
    figure: bool = True,
    progress: Progress = no_progress,
    warn: Callable[[str], None] = lambda _: None,
) -> Checkpoint:
    """Trains an ensemble and writes its checkpoint, together with all processes that `torchrun` started.

    Each member's state is saved next to ``out`` every minute, until the checkpoint is written. A figure beside it,
    ``.png``, shows the training error and the estimates on the validation data. With ``steps``,
    on the CPU with one thread, the result is bit for bit the same for a seed, also after an interruption.

    Args:
        config: The recipe.
        clips: Training data.
        out: Checkpoint to write. All processes read it, so all machines need access to it.
        validation_clips: Clips to measure the checkpoint's stated error on; None for sets held out of
            ``clips``, or for objects if no object has two sets.
        init: Checkpoint with the initial weights, whose networks and preprocessing replace those that the
            recipe leaves unset; None for random weights. Its batch normalisation keeps its statistics unless
            ``freeze_statistics`` is false: a few recordings would change them more than the weights.
        teacher: Checkpoint whose estimates are learned beside the labels, by ``teacher_share``; None for none.
        replay_clips: Recordings of an earlier training, from which ``replay_share`` of each step's clips are
            drawn, so that their objects are not forgotten.
        resume: Continue an interrupted training from its saved states.
        figure: Draw the figure. A Gaussian process has none.
        progress: Called with the training error; `PROGRESS_STEPS` for each network in total.
        warn: Called with a sentence if the training was too short to draw a clip from each recording, or to
            converge, or if there are too few validation clips for an out-of-distribution score.

    Returns:
        The checkpoint as written.

    Raises:
        DataError: There is only one set, no frame shows contact, no validation frame has a label, or a recording is
            too short or of another size.
        NonFiniteError: The training diverged.
        CheckpointError: A state belongs to another recipe or other data, or a file can't be written.
        ConfigError: The recipe sets a key in which ``init`` differs, ``init`` or ``replay_clips`` are given for
            a Gaussian process, or the processes can't train together, for example because their recipes differ.
    """
    check_writable(out)
    if not clips or (validation_clips is not None and not validation_clips):
        use = "validate with" if clips else "train on"
        raise DataError(f"no recording is left to {use}; add logs, or hold out fewer objects")
    if config.method == "process":
        if init is not None or replay_clips:
            raise ConfigError(FITTED_AT_ONCE)
        with join_training_processes("cpu") as process:
            if process.first:
                _fit(config, clips, out, validation_clips, progress)
            process.wait()
            return load_checkpoint(out)
    config = _checked_recipe(config, init, teacher)
    training, held_out = clips, validation_clips
    if held_out is None:
        training, held_out = _split(config, clips)
    check_size([*training, *held_out, *replay_clips], config.preprocess)
    label_mask(
        held_out, config.preprocess.lead_in
    )  # raises, before hours of work, if there is no error to state
    states = state_paths(config, out)
    with join_training_processes(config.device) as process:
        trainers = _trained(
            config, training, states, init, teacher, replay_clips, resume, process, progress, warn
        )
        if process.first:
            networks = [trainer.network for trainer in trainers]
            forces_n, measured_n = labelled_estimates(held_out, networks, config.preprocess, process.device)
            labels_n = _labels_n(training)
            data = [*clips, *replay_clips]
            _save(out, networks, config, data, forces_n, measured_n, float(labels_n.mean()))
            _add_ood(out, networks, held_out, process.device, warn)
            if figure:
                _draw(out, trainers, config, held_out, forces_n, measured_n, float(labels_n.std()))
            for state in states:
                state.unlink()
        process.wait()
        return load_checkpoint(out)


def _checked_recipe(config: TrainConfig, init: Checkpoint | None, teacher: Checkpoint | None) -> TrainConfig:
    """Returns the recipe with what it takes over from ``init``, after a check that ``teacher`` sees the same images."""
    if init is not None:
        config = continued(config, init.header)
    elif config.freeze_statistics:
        raise ConfigError(
            "freeze_statistics keeps those of an initial checkpoint; add --init, or set it to false"
        )
    if teacher is not None and teacher.header.preprocess != config.preprocess:
        raise ConfigError(
            f"the teacher sees frames prepared with {teacher.header.preprocess}, and this network with "
            f"{config.preprocess}; set the same preprocess keys"
        )
    return config


def _split(config: TrainConfig, clips: Sequence[Clip]) -> tuple[list[Clip], list[Clip]]:
    """Splits clips into training and validation: by set, or by object if no object has two sets."""
    repeated = len({clip.object for clip in clips}) < len({(clip.object, clip.set) for clip in clips})
    return split_by(clips, "set" if repeated else "object", config.validation, config.seed)


def _draw(
    out: Path,
    trainers: Sequence[Trainer],
    config: TrainConfig,
    clips: Sequence[Clip],
    forces_n: npt.NDArray[np.float32],
    measured_n: npt.NDArray[np.float32],
    constant_rmse_n: float,
) -> None:
    """Draws the training error, and the estimates of the labelled frames of the validation clips."""
    losses = {
        f"{i}, {trainer.network.config.attention}": np.array(trainer.losses).reshape(-1, 2)
        for i, trainer in enumerate(trainers, 1)
    }
    labelled = [clip.labelled(config.preprocess.lead_in) for clip in clips]
    objects = np.concatenate(
        [np.full(int(mask.sum()), clip.object) for clip, mask in zip(clips, labelled, strict=True)]
    )
    title = f"{out.name}: MAE {metrics.mae(forces_n, measured_n):.3f} N on validation data"
    draw_training(losses, measured_n, forces_n, objects, constant_rmse_n, title, out.with_suffix(".png"))


def _add_ood(
    out: Path,
    networks: Sequence[ForceNetwork],
    clips: Sequence[Clip],
    device: str,
    warn: Callable[[str], None],
) -> None:
    if (ood := fit_ood(networks, read_checkpoint(out)[2], clips, device)) is not None:
        add_ood(out, ood, None, out)
    else:
        warn(
            f"the checkpoint has no out-of-distribution score, which needs {MIN_LOGS} validation logs of {FOLDS} sets "
            "that show contact; fit one with `gripper-force calibrate network`"
        )


def _fit(
    config: TrainConfig,
    clips: Sequence[Clip],
    out: Path,
    validation_clips: Sequence[Clip] | None,
    progress: Progress,
) -> None:
    """Fits a Gaussian process and writes its checkpoint. Its stated error is that on objects left out."""
    check_size([*clips, *(validation_clips or [])], config.preprocess)
    process, _, left_out_n = few.fit(clips, config.preprocess, progress)
    if validation_clips is None:
        used = label_mask(clips, config.preprocess.lead_in)
        forces_n = np.concatenate(left_out_n)[used]
        measured_n = np.concatenate([clip.forces_n for clip in clips])[used]
    else:
        forces_n, measured_n = labelled_estimates(validation_clips, [process], config.preprocess, "cpu")
    _save(out, [process], config, clips, forces_n, measured_n, float(_labels_n(clips).mean()))


def _labels_n(clips: Sequence[Clip]) -> npt.NDArray[np.float32]:
    return np.concatenate([clip.forces_n[clip.valid] for clip in clips])


def _save(
    out: Path,
    networks: Sequence[Member],
    config: TrainConfig,
    clips: Sequence[Clip],
    forces_n: npt.NDArray[np.float32],
    measured_n: npt.NDArray[np.float32],
    mean_n: float,
) -> None:
    header = Header(
        members=tuple(network.config for network in networks),
        preprocess=config.preprocess,
        residuals=residuals(forces_n, measured_n),
        data_digest=digest(clips),
        trained_on=trained_on(clips),
        views=fit_views(clips, config.preprocess),
        metrics={
            **errors(forces_n, measured_n),
            "constant_mae_n": metrics.mae(np.full_like(measured_n, mean_n), measured_n),
        },
    )
    save_checkpoint(out, networks, header)


def trained_on(clips: Sequence[Clip]) -> Tree | None:
    """Returns the number of rigs that clips were recorded with, and the first one's settings; None if unknown."""
    if not all(clip.rig for clip in clips):
        return None
    rigs = {json.dumps([clip.rig, clip.view], sort_keys=True) for clip in clips}
    return {"rigs": len(rigs), **clips[0].rig}


def state_paths(config: TrainConfig, out: Path) -> list[Path]:
    """Returns the files in which a training saves its states, one for each network."""
    if config.method == "process":
        return []
    return [out.with_suffix(f".{i}.state") for i in range(len(config.attentions))]


def _trained(
    config: TrainConfig,
    clips: Sequence[Clip],
    states: Sequence[Path],
    init: Checkpoint | None,
    teacher: Checkpoint | None,
    replay_clips: Sequence[Clip],
    resume: bool,
    process: TrainingProcess,
    progress: Progress,
    warn: Callable[[str], None],
) -> list[Trainer]:
    batches = _batches(config, clips, replay_clips, process)
    start = " ".join(checkpoint.digest if checkpoint is not None else "" for checkpoint in (init, teacher))
    data = digest([*clips, *replay_clips])
    identity = f"{config.model_dump_json(exclude={'device', 'compile'})} {data} {start}"
    trainers = []
    for member, state in enumerate(states):
        trainer = Trainer(
            config, member, batches, process, teacher.force_networks if teacher is not None else ()
        )
        trainers.append(trainer)
        if init is not None:
            trainer.start_from(init.force_networks[member])
        if resume:
            trainer.restore(state, identity)
        process.check_equal(f"{identity} {trainer.done}", "recipes, data or states")
        _run(trainer, config.attentions[member], state, identity, process, progress)
    _warn_of_a_short_training(config, trainers, int(batches.unseen.sum()), len(clips), warn)
    return trainers


def _batches(
    config: TrainConfig, clips: Sequence[Clip], replay_clips: Sequence[Clip], process: TrainingProcess
) -> Batches | Replay:
    """Returns the source of the clips of each step, after a check that the processes can share them."""
    replayed = config.replayed if replay_clips else 0
    if any(0 < part < process.world_size for part in (config.clips - replayed, replayed)):
        raise ConfigError(
            f"{process.world_size} processes can't share {config.clips} clips per step; increase clips"
        )
    if process.world_size > 1 and config.compile:
        raise ConfigError("compile does not work with several processes; set compile=false")
    batches = Batches(clips, config, process)
    if not replay_clips:
        return batches
    return Replay(batches, Batches(replay_clips, config, process), config.replay_share)


def _run(
    trainer: Trainer,
    name: str,
    state: Path,
    identity: str,
    process: TrainingProcess,
    progress: Progress,
) -> None:
    """Makes all steps of a network's training; saves its state every minute and at the end."""
    saved = time.monotonic()
    reported = 0
    for rmse_n in trainer.steps():
        done = int(PROGRESS_STEPS * min(1.0, trainer.done))
        progress(f"{name}: RMSE {rmse_n:.3f} N", done - reported)
        reported = done
        if process.first and time.monotonic() - saved > STATE_EVERY_S:
            trainer.save(state, identity)
            saved = time.monotonic()
    progress(f"{name}: done", PROGRESS_STEPS - reported)
    trainer.network.eval()
    if process.first:
        trainer.save(state, identity)


def _warn_of_a_short_training(
    config: TrainConfig, trainers: Sequence[Trainer], unseen: int, clips: int, warn: Callable[[str], None]
) -> None:
    """Warns if no part of ``unseen`` of the ``clips`` was drawn, or if there were few steps."""
    length = next(key for key in ("minutes", "epochs", "steps") if getattr(config, key) is not None)
    if unseen:
        warn(
            f"the training was too short: it drew no clip from {unseen} of its {clips} recordings; "
            f"increase {length}"
        )
    elif (fewest := min(trainer.step for trainer in trainers)) < MIN_STEPS:
        warn(
            f"the training made only {fewest} steps; a network needs at least {MIN_STEPS}, so increase {length} or, "
            "with a few recordings, use --recipe few"
        )
