import itertools
import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.config import Config
from gripper_force.qualification import soak as soaking
from gripper_force.qualification.soak import WARM_UP, Growth, Sample, measure_growth, soak
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import NS_PER_S, Event


def rising(mb_per_grasp: float = 0.0, handles: int = 0, threads: int = 0) -> list[Sample]:
    """Samples of an hour of grasps with this growth per grasp, after a warm-up with large growth."""
    cold = [Sample(6.0 * i, 300.0 + 40 * i, 9, 2) for i in range(WARM_UP)]
    warm = range(595)
    return cold + [
        Sample(6.0 * (WARM_UP + i), 500 + mb_per_grasp * i, 9 + handles * i, 4 + threads * i) for i in warm
    ]


def test_memory_that_rises_only_in_the_warm_up_is_no_growth() -> None:
    assert measure_growth(rising()) == Growth(ok=True, growth_mb=0.0, slope_mb_h=0.0)


@pytest.mark.parametrize("samples", [rising(mb_per_grasp=0.04), rising(handles=1), rising(threads=1)])
def test_growth_of_memory_handles_or_threads_is_found(samples: list[Sample]) -> None:
    assert not measure_growth(samples).ok


def test_different_memory_of_objects_is_not_growth() -> None:
    samples = [replace(s, memory_mb=s.memory_mb + 40 * (i % 4 == 1)) for i, s in enumerate(rising())]
    for count in range(WARM_UP + 4, WARM_UP + 20):
        assert measure_growth(samples[:count]).growth_mb == 0


def test_growth_counts_from_the_end_of_the_warm_up() -> None:
    growth = measure_growth(rising(mb_per_grasp=0.01))
    assert growth.ok
    assert growth.growth_mb == pytest.approx(5.91)
    assert growth.slope_mb_h == pytest.approx(6.0, abs=0.05)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes a test of one object as short as it can be: one grasp to warm up, and one that counts."""
    monkeypatch.setattr(soaking, "WARM_UP", 1)
    monkeypatch.setattr(soaking, "PAPER_OBJECTS", ("stapler",))


def grasped(config: Config, seconds: int = 1) -> dict[str, Any]:
    """Writes a log of this length in place of a grasp, without a gripper."""
    with LogWriter(config.log.directory / "run.mcap", config="", metadata={}) as log:
        for t_s in (0, seconds):
            log.write(Event(t_s * NS_PER_S, "session", "tick"))
    return {"result": "held"}


@pytest.mark.usefixtures("short")
def test_stability_soak_finds_no_growth_in_a_few_grasps(quick_vision: list[str]) -> None:
    keys = [*quick_vision, "camera.rate_hz=20"]  # frames take most of the time
    sets = [part for one in keys for part in ("--set", one)]
    done = CliRunner().invoke(
        cli.app, ["stability", "soak", "--seconds", "0", "--seed", "3", "--json", *sets]
    )
    assert done.exit_code == 0, done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    assert report["ok"] is True
    assert report["grasps"] == 2 == sum(report["outcomes"].values())
    assert report["simulated_s"] > 2
    last, warm = report["samples"][-1], report["samples"][1]
    assert (last["handles"], last["threads"]) == (warm["handles"], warm["threads"])


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("grasps", [1, 2])
def test_interrupt_returns_the_results_so_far(grasps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    left = iter(range(grasps))

    def interrupted(config: Config) -> dict[str, Any]:
        if next(left, None) is None:
            raise KeyboardInterrupt
        return grasped(config)

    monkeypatch.setattr(soaking, "grasp", interrupted)
    if grasps < 2:  # too few to compare
        with pytest.raises(KeyboardInterrupt):
            soak(Config(), 3600)
        return
    report = soak(Config(), 3600)
    assert (report["ok"], report["grasps"], report["simulated_s"]) == (False, 2, 2.0)


def test_growth_of_memory_is_found_in_the_shortest_test(monkeypatch: pytest.MonkeyPatch) -> None:
    memory_mb = itertools.count(300.0, 40.0)

    monkeypatch.setattr(soaking, "grasp", grasped)
    monkeypatch.setattr(soaking, "_sample", lambda done_s: Sample(done_s, next(memory_mb), 9, 2))
    report = soak(Config(), 0)
    assert (report["ok"], report["growth_mb"]) == (False, 4 * 40.0)


@pytest.mark.usefixtures("short")
def test_leaked_threads_and_files_are_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    left: list[Any] = []
    end = threading.Event()

    def leaky(config: Config) -> dict[str, Any]:
        left.append((tmp_path / "left").open("wb"))
        left.append(threading.Thread(target=end.wait, daemon=True))
        left[-1].start()
        return grasped(config, seconds=2)

    monkeypatch.setattr(soaking, "grasp", leaky)
    try:
        report = soak(Config(), 6)
    finally:
        end.set()
        for one in left:
            one.join() if isinstance(one, threading.Thread) else one.close()
    assert report["ok"] is False
    last, warm = report["samples"][-1], report["samples"][1]
    assert (report["grasps"], report["simulated_s"]) == (3, 6.0)
    assert (last.handles, last.threads) == (warm.handles + 2, warm.threads + 2)
