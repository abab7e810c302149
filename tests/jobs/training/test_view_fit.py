import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.training import ood_fit
from gripper_force.jobs.training.ood_fit import calibrate_network
from gripper_force.jobs.training.view_fit import MIN_VIEWS, fit_views
from gripper_force.types import Gray
from gripper_force.vision.header import read_checkpoint
from gripper_force.vision.known_views import view_score
from gripper_force.vision.preprocess import Preprocess


def picture(seed: int, *, disc: bool = False) -> Gray:
    """A square or a disc of a random size and place before a random background."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:64, :64] - rng.uniform(28, 36, 2)[:, None, None]
    radius = rng.uniform(14, 18)
    inside = np.hypot(x, y) < radius if disc else np.maximum(abs(x), abs(y)) < radius
    image: Gray = (rng.normal(70, 5, (64, 64)) + rng.uniform(60, 90) * inside).clip(0, 255).astype(np.uint8)
    return image


def clips_of(press: Callable[..., Clip], count: int) -> list[Clip]:
    clip = press(0)
    return [
        replace(clip, frames=np.repeat(picture(i)[None], 8, axis=0), set=f"s{i}", name=f"c{i}")
        for i in range(count)
    ]


def test_known_shapes_are_within_the_limit_and_others_are_not(press: Callable[..., Clip]) -> None:
    views = fit_views(clips_of(press, 3 * MIN_VIEWS), Preprocess(size=64))
    assert views is not None
    known = [view_score(views, picture(1000 + i)) for i in range(40)]
    unknown = [view_score(views, picture(2000 + i, disc=True)) for i in range(40)]
    assert np.mean(np.array(known) > 1) <= 0.05
    assert np.mean(np.array(unknown) > 1) > 0.95


def test_a_view_needs_a_reference_and_many_sets(press: Callable[..., Clip]) -> None:
    clips = clips_of(press, MIN_VIEWS)
    assert fit_views(clips, Preprocess(size=64)) is not None
    assert fit_views(clips[1:], Preprocess(size=64)) is None
    assert fit_views(clips, Preprocess(size=64, reference=False)) is None
    again = [replace(clip, name=f"{clip.name} again") for clip in clips[1:]]
    assert fit_views([*clips[1:], *again], Preprocess(size=64)) is None, "two logs of a set show one view"


def test_calibrate_network_keeps_the_views_of_a_checkpoint_if_the_logs_show_few(
    press: Callable[..., Clip], write_log: Callable[[Clip, Path], Path], tmp_path: Path
) -> None:
    before = read_checkpoint("small")[2].views
    logs = [write_log(press(seed), tmp_path) for seed in range(12)]
    out = tmp_path / "out.safetensors"
    calibrate_network(logs, out, "small")
    assert before is not None
    assert read_checkpoint(out)[2].views == before


def test_the_command_tells_the_limit_or_that_the_views_stay(
    press: Callable[..., Clip],
    write_log: Callable[[Clip, Path], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for seed in range(MIN_VIEWS):
        write_log(replace(press(seed), set=f"s{seed}"), tmp_path)
    out = tmp_path / "out.safetensors"
    call = ["calibrate", "network", str(tmp_path), "--checkpoint", "small", "--out", str(out), "--jobs", "1"]
    done = CliRunner().invoke(cli.app, [*call, "--json"])
    views = read_checkpoint(out)[2].views
    assert views is not None
    assert json.loads(done.stdout)["view_limit"] == views.limit
    assert "left out" not in done.stderr
    unknown = "times what the network claimed: it does not know what they show"
    assert unknown in done.stderr, "no network has seen these pictures"
    monkeypatch.setattr(ood_fit, "UNKNOWN_FACTOR", 1e9)
    first = min(tmp_path.glob("*.mcap"))
    first.unlink()
    clip = press(0)
    write_log(replace(clip, name=first.stem, forces_n=clip.forces_n + 1), tmp_path)
    done = CliRunner().invoke(cli.app, call)
    assert "as before: there are too few sets" in done.stdout
    assert unknown not in done.stderr
    assert f"warning: left out 1 of {MIN_VIEWS} logs, which start in contact" in done.stderr
    assert f"{2 * MIN_VIEWS}/{2 * MIN_VIEWS}" in done.stderr
