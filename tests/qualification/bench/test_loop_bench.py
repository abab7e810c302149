import json
import math
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.qualification.bench import loop_bench as loop
from gripper_force.qualification.bench.loop_bench import LogCost, LoopCost


def test_the_loop_runs_in_real_time_with_vision_and_without(tiny_checkpoint: Path) -> None:
    (eyes, blind), log = loop.loop(1.0, [f"vision.checkpoint={tiny_checkpoint}"])
    assert (eyes.beside, blind.beside) == ("vision", "nothing")
    assert eyes.estimates_hz > 0 == blind.estimates_hz
    assert eyes.estimator_p99_ms >= eyes.estimator_p50_ms > 0
    assert math.isnan(blind.estimator_p50_ms)
    for cost in (eyes, blind):
        assert cost.cycles > 0 <= cost.missed
        assert 0 <= cost.late_p50_ms <= cost.late_p99_ms <= cost.late_max_ms
        assert 0 < cost.bus_p50_ms <= cost.cycle_p99_ms
    assert min(log.run_mb_s, log.write_mb_s, log.record_us, log.replay_times) > 0


def test_what_the_loop_did_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    cost = LoopCost("nothing", 6000, 3, 0, *(float(ms) for ms in range(7)), math.nan, math.nan, 0.0)
    monkeypatch.setattr(
        loop, "loop", lambda seconds, _: ((cost,) * int(seconds), LogCost(1.0, 2.0, 3.0, 4.0))
    )
    call = ["bench", "--loop", "--seconds", "2"]
    assert "0.050" in CliRunner().invoke(cli.app, call).stdout
    told = json.loads(CliRunner().invoke(cli.app, [*call, "--json"]).stdout)
    assert [row["missed"] for row in told["loop"]] == [3, 3]
    assert {"log", "load", "cores"} < set(told)


def test_bench_measures_one_thing_at_a_time() -> None:
    done = CliRunner().invoke(cli.app, ["bench", "--loop", "--startup"])
    assert "one thing at a time" in str(done.exception)
