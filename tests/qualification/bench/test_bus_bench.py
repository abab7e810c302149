import json

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.qualification.bench import bus_bench as bus
from gripper_force.qualification.bench.bus_bench import BusCost, bus_cost


def test_bench_bus_prints_a_table_and_json(monkeypatch: pytest.MonkeyPatch) -> None:
    def cost(baud_rate: int, latency_ms: float, cycles: int) -> tuple[BusCost, ...]:
        return (BusCost("plain SDK", baud_rate, latency_ms, 1.0, 2.0, 3.0 * cycles, 0.25),)

    monkeypatch.setattr(bus, "bus_cost", cost)
    call = ["bench", "bus", "--cycles", "2"]
    assert "plain SDK" in CliRunner().invoke(cli.app, call).stdout
    done = CliRunner().invoke(cli.app, [*call, "--json"])
    (line,) = done.stdout.splitlines()
    printed = json.loads(line)
    assert done.exit_code == 0
    assert [(row["baud_rate"], row["latency_ms"]) for row in printed["bus"]] == list(bus.BUS_SETTINGS)
    assert {row["p99_ms"] for row in printed["bus"]} == {6.0}
    assert {"load", "cores"} < set(printed)


def test_bench_bus_rejects_configuration_keys() -> None:
    done = CliRunner().invoke(cli.app, ["bench", "bus", "--set", "servo.id=2"])
    assert "bench bus uses no configuration; leave out --set servo.id=2" in str(done.exception)


def test_cycle_takes_at_least_the_time_of_its_bytes_on_the_line() -> None:
    cycles, baud_rate, latency_ms = 4, 230_400, 2.0
    ours, shared, theirs, bare = bus_cost(baud_rate, latency_ms, cycles)
    assert [c.client for c in (ours, shared, theirs, bare)] == [
        "driver",
        "driver, arm",
        "plain SDK",
        "bare bytes",
    ]
    assert shared.line_ms > 2 * ours.line_ms - latency_ms
    for cost in (ours, theirs, bare):
        assert (cost.baud_rate, cost.latency_ms) == (baud_rate, latency_ms)
        assert latency_ms < cost.line_ms
        assert cost.line_ms / 2 < cost.p50_ms <= cost.p99_ms  # the first cycle finds a free line
        assert cost.cpu_share > 0
    # A sync read of ten bytes and a sync write of four, for two servos: 16, 42 and 24 bytes. The last write
    # may still be on its way when the bytes are counted.
    a_byte_ms = 10_000 / baud_rate
    assert (82 - 24 / cycles) * a_byte_ms <= theirs.line_ms - latency_ms + 1e-9
    assert theirs.line_ms - latency_ms <= 82 * a_byte_ms + 1e-9
