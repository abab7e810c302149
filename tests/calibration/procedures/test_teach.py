"""Teaching from logs of a synthetic press, with tiny networks: what is chosen, kept, written and used."""

import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from gripper_calibration.procedures import teach as job
from gripper_calibration.procedures import teach_candidates as candidates
from gripper_calibration.procedures.teach import STEPS, Taught, teach
from gripper_calibration.procedures.teach_candidates import MIN_LOGS
from gripper_force.cli import app
from gripper_force.config import Config, load_config
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.dataset import Clip, find_logs, load_clips
from gripper_force.jobs.evaluate import evaluate
from gripper_force.jobs.profile_files import write_all
from gripper_force.jobs.training import recipe as recipes
from gripper_force.jobs.training.recipe import TrainConfig
from gripper_force.jobs.training.train import train
from gripper_force.profiles.apply import with_bundle
from gripper_force.profiles.object_profile import read_object
from gripper_force.runtime.resolve import make_estimator, resolve
from gripper_force.types import Gray
from gripper_force.vision.estimator import ForceEstimator
from gripper_force.vision.header import read_checkpoint
from gripper_force.vision.preprocess import Preprocess

pytestmark = pytest.mark.usefixtures("one_thread", "no_figures")


OBJECTS = Path(__file__).parents[3] / "examples" / "objects"
SHORT = {"steps": 2, "clips": 2}


@pytest.fixture(scope="module", autouse=True)
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A training of two steps, and a folder of profiles of its own."""
    folder = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(recipes.RECIPES, "touches", {**recipes.RECIPES["touches"], **SHORT})
        patch.setenv("XDG_DATA_HOME", str(folder))
        yield folder / "gripper-force" / "objects"


@pytest.fixture(scope="module")
def logs(
    press: Callable[..., Clip],
    write_log: Callable[..., Path],
    tmp_path_factory: pytest.TempPathFactory,
) -> list[Path]:
    """Six touches of a disc."""
    folder = tmp_path_factory.mktemp("disc")
    # A log of a run has the torque constant, and an imported recording has not.
    return [write_log(press(seed), folder, "gripper.nm_per_a=1.8") for seed in range(6)]


@pytest.fixture(scope="module")
def network(press: Callable[..., Clip], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small network that knows the disc somewhat."""
    path = tmp_path_factory.mktemp("network") / "tiny.safetensors"
    config = TrainConfig(
        attentions=("ssam",),
        width=0.5,
        hidden=32,
        head=64,
        preprocess=Preprocess(size=16),
        steps=60,
        clips=6,
        device="cpu",
        seed=1,
    )
    train(config, [replace(press(seed), object=f"o{seed}") for seed in range(20, 28)], path, figure=False)
    return path


@pytest.fixture(scope="module")
def config(network: Path) -> Config:
    return load_config(None, [f"vision.checkpoint={network}"])


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of `taught`."""
    return tmp_path_factory.mktemp("taught")


@pytest.fixture(scope="module")
def taught(config: Config, logs: list[Path], work: Path) -> Taught:
    return teach(config, "disc", logs=logs, folder=work)


def test_bundle_holds_network_profile_and_origin(taught: Taught, logs: list[Path], home: Path) -> None:
    assert taught.bundle == home / "disc"
    assert {path.name for path in taught.bundle.iterdir()} == {
        "profile.yaml",
        "profile.safetensors",
        "network.safetensors",
        "teach.png",
    }
    profile = read_object(taught.bundle / "profile.yaml")
    assert profile == taught.profile
    assert len(profile.logs) == len(logs)
    assert profile.version
    assert profile.camera["camera.exposure_us"] == 4000
    assert profile.camera["gripper.open_width_m"] == 0.092
    assert profile.checkpoint == resolve(load_config(None, ["object=disc"])).model.digest  # type: ignore[union-attr]


def test_a_real_camera_may_have_a_region(
    taught: Taught, config: Config, logs: list[Path], work: Path, tmp_path: Path
) -> None:
    real = config.with_values(clock="realtime", vision={"region": (40, 40, 400, 400)})
    result = teach(real, "disc", logs=logs, folder=work, out=tmp_path / "disc")
    assert result.learned == taught.learned


def test_best_candidate_is_taken_and_its_error_is_that_on_new_touches(
    taught: Taught, press: Callable[..., Clip], write_log: Callable[[Clip, Path], Path], tmp_path: Path
) -> None:
    assert list(taught.candidates_mae_n) == [
        "tiny.safetensors as it is",
        "tiny.safetensors, trained",
        "Gaussian process",
    ]
    best = min(taught.candidates_mae_n.values())
    assert taught.candidates_mae_n[taught.learned] < 1.5 * best
    assert taught.mae_n < taught.before_n
    assert taught.coverages[0].touches == 6
    assert taught.profile.after_n == taught.mae_n
    new = [write_log(press(seed), tmp_path / "new") for seed in range(40, 46)]
    found = evaluate(new, taught.bundle / "network.safetensors", profile=str(taught.bundle))
    assert 0.4 * taught.mae_n < found.mae_n < 2.5 * taught.mae_n
    assert taught.fewer_mae_n > 0


def test_finished_parts_are_not_repeated(
    taught: Taught,
    config: Config,
    logs: list[Path],
    work: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Three of the trainings are missing; the work is interrupted while the second of them is written."""
    folder, out = tmp_path / "work", tmp_path / "bundle"
    shutil.copytree(work, folder)
    parts = sorted((folder / "teach").glob("*.left"), key=lambda path: path.stat().st_size)
    assert len(parts) == 8  # the network as it is, six trainings, and the process
    for path in parts[:3]:
        path.unlink()
    evaluated: list[str] = []
    make = candidates._evaluate

    def noting(task: candidates._Task) -> None:
        evaluated.append(task.candidate.name)
        make(task)

    def interrupted(files: dict[Path, bytes]) -> None:
        if len(evaluated) == 2:
            raise KeyboardInterrupt
        write_all(files)

    monkeypatch.setattr(candidates, "_evaluate", noting)
    monkeypatch.setattr(candidates, "write_all", interrupted)
    with pytest.raises(KeyboardInterrupt):
        teach(config, "disc", logs=logs, folder=folder, out=out)
    assert not out.exists()
    steps: list[int] = []
    resumed = teach(
        config,
        "disc",
        logs=logs,
        folder=folder,
        out=out,
        progress=lambda _text, steps_done=1: steps.append(steps_done),
    )
    assert evaluated == 4 * ["tiny.safetensors, trained"]
    assert sum(steps) == STEPS
    assert resumed.candidates_mae_n == taught.candidates_mae_n
    assert resumed.profile.weights == taught.profile.weights


def test_a_replayed_touch_is_never_learned_where_it_is_left_out(
    taught: Taught, config: Config, logs: list[Path], work: Path, tmp_path: Path
) -> None:
    """The parts of `taught` are used again, unless the touches change what is learned."""
    again = tmp_path / "again"
    again.mkdir()
    for path in logs:
        (again / path.name).write_bytes(path.read_bytes())
    parts = {path: path.stat().st_mtime_ns for path in work.rglob("*.left")}
    found = teach(config, "disc", logs=logs, replay=[again], folder=work, out=tmp_path / "bundle")
    assert found.candidates_mae_n == taught.candidates_mae_n
    assert {path: path.stat().st_mtime_ns for path in work.rglob("*.left")} == parts


def test_replayed_logs_are_read_by_the_trainings_alone(
    write_log: Callable[[Clip, Path], Path],
    press: Callable[..., Clip],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clip = press(9)
    free = write_log(replace(clip, name="free"), tmp_path)
    pressed = write_log(replace(clip, name="pressed", forces_n=clip.forces_n + 1), tmp_path)

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the whole log was read")

    monkeypatch.setattr(job, "load_clips", refuse)
    assert [job._starts_in_contact(path, Preprocess()) for path in (free, pressed)] == [False, True]


@pytest.fixture
def as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves the network as it is as the only candidate, for tests of the logs that are used."""
    make = candidates.make_candidates
    monkeypatch.setattr(job, "make_candidates", lambda *arguments, **named: make(*arguments, **named)[:1])


@pytest.mark.usefixtures("as_it_is")
def test_more_touches_continue_with_the_old_ones(config: Config, logs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "bundles" / "disc"
    first = teach(config, "disc", logs=logs[:4], folder=tmp_path / "work", out=out)
    second = teach(config, "disc", logs=logs[:5], folder=tmp_path / "work", out=out)
    assert second.profile.logs[:4] == first.profile.logs
    assert read_object(second.bundle / "profile.yaml").touches == 5
    assert [path.name for path in second.bundle.parent.iterdir()] == ["disc"]


def test_grasps_find_the_bundle_by_the_object_and_a_setting_prevents_it(taught: Taught) -> None:
    used, note = with_bundle(load_config(None, ["object=disc"]))
    assert used.vision.checkpoint == str(taught.bundle / "network.safetensors")
    assert note.startswith(f"used the bundle {taught.bundle}, made of 6 touches on ")
    assert ("session", note) in resolve(load_config(None, ["object=disc"])).notes
    for keys in (["object=sponge"], ["object=disc", "calibration.object=none"]):
        assert with_bundle(load_config(None, keys)) == (load_config(None, keys), "")
    small = load_config(None, ["object=disc", "vision.checkpoint=small"])
    assert with_bundle(small)[0] == small
    assert "because vision.checkpoint is 'small'; set it to default" in with_bundle(small)[1]
    assert with_bundle(used) == (used, "")
    by_path = load_config(None, [f"calibration.object={taught.bundle}"])
    assert with_bundle(by_path)[0].vision.checkpoint == used.vision.checkpoint
    again = load_config(None, ["object=disc", f"calibration.object={taught.bundle}/profile.yaml"])
    assert with_bundle(again)[0] == used.with_values(object="disc")


def test_own_profiles_bring_their_networks_to_an_evaluation(taught: Taught, logs: list[Path]) -> None:
    network, profile = taught.bundle / "network.safetensors", taught.bundle / "profile.yaml"
    named = evaluate(logs, network, profile=str(profile))
    for given in ("own", "disc"):
        assert evaluate(logs, profile=given).mae_n == named.mae_n


@pytest.mark.parametrize(
    ("key", "sentence"),
    [
        ("camera.exposure_us=8000", r"camera.exposure_us 4000, not 8000"),
        ("vision.region=[0, 0, 64, 64]", r"vision.region None, not \[0, 0, 64, 64\]"),
        ("gripper.pinion_radius_m=0.03", r"gripper.pinion_radius_m 0.02, not 0.03"),
        ("sim.tool=rods", r"sim.tool pads, not rods"),
    ],
)
def test_another_rig_is_refused_or_warned_about(taught: Taught, key: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        resolve(load_config(None, ["object=disc", key]))
    allowed = load_config(None, ["object=disc", "calibration.on_mismatch=warn", key])
    assert any(
        f"the object profile was made with {key.split('=')[0]}" in text for _, text in resolve(allowed).notes
    )


@pytest.mark.parametrize("taken", [1, 2])
def test_any_learned_estimator_states_errors_and_a_score_from_touches_left_out(
    taken: int,
    taught: Taught,
    config: Config,
    logs: list[Path],
    work: Path,
    press: Callable[..., Clip],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A trained network, and a process: neither is what `taught` takes."""
    monkeypatch.setattr(candidates, "select_simplest", lambda _: taken)
    found = teach(config, "disc", logs=logs, folder=work, out=tmp_path / "disc")
    assert found.learned == list(taught.candidates_mae_n)[taken]
    header = read_checkpoint(found.bundle / "network.safetensors")[2]
    assert header.trained_on is not None
    assert header.trained_on["rigs"] == 1
    assert header.metrics["mae_n"] > 0
    assert header.ood is not None
    assert found.profile.ood_limits is not None
    network = found.bundle / "network.safetensors"
    for profile in ("none", found.bundle):  # the network's score, and the profile's
        assert _rejected_share(network, profile, press) < 0.2


def test_limits_fit_the_final_network_if_those_of_the_folds_have_smaller_scores(
    config: Config,
    logs: list[Path],
    work: Path,
    press: Callable[..., Clip],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def scaled(*args: Any) -> candidates.Comparison:
        found = compare(*args)
        return found._replace(left=[one._replace(share=one.share / 1000) for one in found.left])

    compare = candidates.compare
    monkeypatch.setattr(job, "compare", scaled)
    monkeypatch.setattr(candidates, "select_simplest", lambda _: 1)  # the trained network
    found = teach(config, "disc", logs=logs, folder=work, out=tmp_path / "disc")
    assert _rejected_share(found.bundle / "network.safetensors", found.bundle, press) < 0.2


def _rejected_share(network: Path, profile: Path | str, press: Callable[..., Clip]) -> float:
    """Share of the frames of new presses that a run rejects, without an export of the network for other engines."""
    keys = ["vision.engine=torch", f"vision.checkpoint={network}", f"calibration.object={profile}"]
    estimator = make_estimator(resolve(load_config(None, keys)))
    assert estimator is not None
    rejected = []
    for seed in (41, 42, 43):
        estimator.reset()
        rejected += [_is_rejected(estimator, frame) for frame in press(seed).frames]
    return float(np.mean(rejected))


def _is_rejected(estimator: ForceEstimator, frame: Gray) -> bool:
    try:
        estimator.update(frame)
    except DataError:
        return True
    return False


@pytest.mark.usefixtures("as_it_is")
def test_two_files_of_one_name_share_no_bundle(
    network: Path, logs: list[Path], tmp_path: Path, home: Path
) -> None:
    files = [tmp_path / folder / "part.yaml" for folder in "ab"]
    for path in files:
        path.parent.mkdir()
        path.write_text((OBJECTS / "avocado.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    first, second = (load_config(None, [f"object={path}", f"vision.checkpoint={network}"]) for path in files)
    for _ in range(2):  # one that exists is replaced
        assert teach(first, "part", logs=logs[:4], folder=tmp_path / "work").bundle == home / "part"
    with pytest.raises(
        ConfigError, match=r"part is that of the object in .*a/part\.yaml, not of .*b/part\.yaml; "
    ):
        teach(second, "part", logs=logs, folder=tmp_path / "work")
    (tmp_path / "linked").symlink_to(files[0].parent)
    paths = (files[0], tmp_path / "linked" / "part.yaml", tmp_path / "b" / ".." / "a" / "part.yaml", files[1])
    *used, declined = (with_bundle(load_config(None, [f"object={path}"])) for path in paths)
    for config, _ in used:
        assert config.vision.checkpoint == str(home / "part" / "network.safetensors")
    assert declined[0].vision.checkpoint == "default"
    assert declined[1] == f"did not use the bundle {home / 'part'}, which is that of the object in {files[0]}"
    (home / "part" / "profile.yaml").write_text("no profile", encoding="utf-8")
    with pytest.raises(
        ConfigError, match=r"the bundle .*part can't be read, .*; move it away, or name another"
    ):
        teach(first, "part", logs=logs, folder=tmp_path / "work")
    shutil.rmtree(home / "part")


@pytest.mark.parametrize("name", ["a/b", "..", ""])
def test_a_name_that_is_a_path_is_refused(name: str, config: Config, logs: list[Path]) -> None:
    with pytest.raises(
        ConfigError, match=rf"^object '{re.escape(name)}' can't be part of a file name; use letters"
    ):
        teach(config, name, logs=logs)


@pytest.mark.usefixtures("as_it_is")
def test_logs_without_contact_and_too_few_logs(
    config: Config,
    logs: list[Path],
    press: Callable[..., Clip],
    write_log: Callable[[Clip, Path], Path],
    tmp_path: Path,
) -> None:
    clip = press(9)
    free = write_log(replace(clip, name="free", forces_n=0 * clip.forces_n), tmp_path / "free")
    replayed = write_log(replace(clip, name="replayed", forces_n=clip.forces_n + 2), tmp_path / "replayed")
    pressed = write_log(replace(clip, name="pressed", forces_n=clip.forces_n + 1), tmp_path / "pressed")
    found = teach(
        config,
        "disc",
        logs=[*logs[:4], free, pressed],
        replay=[replayed],
        folder=tmp_path / "work",
        out=tmp_path / "b",
    )
    assert found.without_contact == (free,)
    assert found.contact_starts == (pressed, replayed)
    with pytest.raises(
        DataError, match=f"there are 3 different logs of touches with contact, but .* needs {MIN_LOGS}"
    ):
        teach(config, "disc", logs=[*logs[:3], logs[0], free], folder=tmp_path / "work", out=tmp_path / "b")


def test_a_missing_network_is_found_before_the_first_touch(config: Config, tmp_path: Path) -> None:
    blind = config.with_values(vision={"checkpoint": "none"})
    with pytest.raises(ConfigError, match="teach needs a network to begin with"):
        teach(blind, "disc", folder=tmp_path / "touches")
    assert not (tmp_path / "touches").exists()


@pytest.mark.usefixtures("as_it_is")
def test_an_interrupted_replacement_keeps_the_old_bundle(
    taught: Taught,
    config: Config,
    logs: list[Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "disc"
    shutil.copytree(taught.bundle, out)
    rename = Path.rename

    def interrupted(path: Path, target: Path) -> Path:
        if target == out and path.name.endswith(".part"):
            raise KeyboardInterrupt
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt):
        teach(config, "disc", logs=logs[:4], folder=tmp_path / "work", out=out)
    assert read_object(out / "profile.yaml") == taught.profile
    rename(out, out.with_name(".disc.old"))  # as a kill between the two leaves it
    with pytest.raises(KeyboardInterrupt):
        teach(config, "disc", logs=logs[:4], folder=tmp_path / "work", out=out)
    assert read_object(out / "profile.yaml") == taught.profile


def test_folder_that_is_no_bundle_is_not_replaced(
    config: Config, logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine").mkdir()
    with pytest.raises(ConfigError, match="exists and is not a bundle"):
        teach(config, "disc", logs=logs, folder=tmp_path / "work", out=tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    for out in (".", "/"):
        with pytest.raises(ConfigError, match="exists and is not a bundle"):
            teach(config, "disc", logs=logs, folder=tmp_path / "work", out=out)


def test_command_prints_the_choice_and_the_next_command(
    taught: Taught,
    network: Path,
    logs: list[Path],
    work: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    call = ["teach", "disc", "--from", str(logs[0].parent), "--folder", str(work), "--jobs", "1"]
    call += ["--set", f"vision.checkpoint={network}", "--seed", "3"]
    result = CliRunner().invoke(app, [*call, "--json"], catch_exceptions=False)
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["candidates_mae_n"] == taught.candidates_mae_n
    assert found["minutes"] > 0
    assert "next: gripper-force grasp --object disc --target-n 4 --seed 3\n" in result.stderr
    assert found["coverages"]
    both = CliRunner().invoke(app, [*call, "--fresh"])
    assert isinstance(both.exception, ConfigError)
    monkeypatch.setattr(job, "teach", lambda *_, **__: taught)
    rig = tmp_path / "my.yaml"
    rig.write_text(f"vision: {{checkpoint: {network}}}\n", encoding="utf-8")
    table = CliRunner().invoke(
        app, [*call[:8], "--config", str(rig), "--out", str(tmp_path / "b")], catch_exceptions=False
    )
    assert "expected error" in table.stdout
    assert "coverage" in table.stdout
    text = f"--profile {tmp_path / 'b'} --config {rig} --set vision.checkpoint=default"
    assert text in table.stderr.replace("\n", "")
    own = tmp_path / "disc.yaml"
    own.write_text((OBJECTS / "avocado.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    named = CliRunner().invoke(app, ["teach", str(own), *call[2:]], catch_exceptions=False)
    assert named.exit_code == 0
    assert f"--object {own} --target-n 4" in named.stderr.replace("\n", "")


def test_provenance_counts_rigs(logs: list[Path]) -> None:
    from gripper_force.jobs.training.train import trained_on

    clips = load_clips(find_logs(logs), Preprocess(size=16))
    one = trained_on(clips)
    assert one is not None
    assert (one["rigs"], one["camera.exposure_us"]) == (1, 4000)
    other = replace(clips[0], rig={**clips[0].rig, "camera.exposure_us": 2000})
    several = trained_on([*clips, other, replace(clips[1], view="another")])
    assert several is not None
    assert several["rigs"] == 3
    assert trained_on([*clips, replace(clips[0], rig={})]) is None
