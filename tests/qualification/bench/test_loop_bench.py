import json
import math
import shutil
import socket
import sys
import threading
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import GripperError
from gripper_force.qualification.bench import loop_bench as loop
from gripper_force.qualification.bench.loop_bench import LogCost, LoopCost


@pytest.fixture
def short_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shortens the grasp that the camera repeats: a frame takes long to render."""
    short = ("control.settle_s=0.1", "control.hold_s=0.1", "control.approach_speed_m_s=0.05")
    monkeypatch.setattr(loop, "_RECORDING", (*loop._RECORDING, *short))


@pytest.mark.usefixtures("short_recording")
def test_the_loop_runs_in_real_time_with_vision_and_without(tiny_checkpoint: Path) -> None:
    (vision, nothing), log = loop.loop(0.4, [f"vision.checkpoint={tiny_checkpoint}"])
    assert (vision.beside, nothing.beside) == ("vision", "nothing")
    assert vision.estimates_hz > 0 == nothing.estimates_hz
    assert vision.estimator_p99_ms >= vision.estimator_p50_ms > 0
    assert math.isnan(nothing.estimator_p50_ms)
    for cost in (vision, nothing):
        assert cost.cycles > 0 <= cost.missed
        assert 0 <= cost.late_p50_ms <= cost.late_p99_ms <= cost.late_max_ms
        assert 0 < cost.bus_p50_ms <= cost.cycle_p99_ms
    assert min(log.run_mb_s, log.write_mb_s, log.record_us, log.replay_times) > 0


@pytest.mark.usefixtures("short_recording")
def test_foxglove_is_measured_without_the_app(tiny_checkpoint: Path) -> None:
    pytest.importorskip(
        "foxglove", reason="Foxglove's SDK is not installed: pip install 'gripper-force[view]'"
    )
    costs, _ = loop.loop(1.0, [f"vision.checkpoint={tiny_checkpoint}"], viewer="foxglove")
    assert [cost.beside for cost in costs] == ["vision", "nothing", "vision, foxglove"]
    assert costs[2].estimates_hz > 0


def test_a_server_that_is_no_foxglove_server_ends_the_measurement() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def refuse() -> None:
            with server.accept()[0] as connection:
                connection.sendall(b"HTTP/1.1 404 Not Found\r\n\r\n")

        answers = threading.Thread(target=refuse)
        answers.start()
        with pytest.raises(GripperError, match=r"could not use the Foxglove server at ws://.*404 Not Found"):
            loop._foxglove_client(f"ws://127.0.0.1:{server.getsockname()[1]}")
        answers.join()


def test_a_virtual_servo_that_does_not_start_ends_the_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", shutil.which("true"))
    with pytest.raises(GripperError, match="the virtual servo did not start"), loop._virtual_servo():
        pass


def test_bench_loop_prints_a_table_and_json(monkeypatch: pytest.MonkeyPatch) -> None:
    times_ms = 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0
    cost = LoopCost("nothing", 6000, 3, 0, *times_ms, math.nan, math.nan, 0.0)

    def measure(
        seconds: float, _overrides: list[str], _path: Path | None, _viewer: str | None
    ) -> tuple[object, LogCost]:
        return (cost,) * int(seconds), LogCost(1.0, 2.0, 3.0, 4.0)

    monkeypatch.setattr(loop, "loop", measure)
    call = ["bench", "loop", "--seconds", "2"]
    assert "0.050" in CliRunner().invoke(cli.app, call).stdout
    printed = json.loads(CliRunner().invoke(cli.app, [*call, "--json"]).stdout)
    assert [row["missed"] for row in printed["loop"]] == [3, 3]
    assert {"log", "load", "cores"} < set(printed)
