import errno
import io
import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import config_from, load_config
from gripper_force.errors import ConfigError
from gripper_force.fault_config import FAULTS, FaultConfig
from gripper_force.interfaces import Clock
from gripper_hw.fault_injection import Faults, FaultyEstimator, FaultyFile

KINDS = ("off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent")
GRAY = np.zeros((4, 4), np.uint8)


@dataclass
class Two:
    force_n: float = 2.0
    std_n: float = 0.1
    reference: None = None

    def update(self, gray: np.ndarray) -> "Two":
        return self

    def attention_map(self) -> np.ndarray:
        return np.eye(2, dtype=np.float32)


def faults(unit: str, kind: str, at_s: float = 1.0, for_s: float = 1.0) -> Faults:
    return Faults([FaultConfig.model_validate({"unit": unit, "kind": kind, "at_s": at_s, "for_s": for_s})])


@pytest.mark.parametrize("unit", FAULTS)
@pytest.mark.parametrize("kind", KINDS)
def test_unsupported_pairs_are_refused(unit: str, kind: str) -> None:
    tree = {"faults": [{"unit": unit, "kind": kind, "for_s": 1.0}]}
    if kind in FAULTS[unit]:
        assert config_from(tree, "test").faults[0].kind == kind
    else:
        with pytest.raises(ConfigError, match=f"unit {unit} has no fault kind {kind}; choose one of ok, "):
            config_from(tree, "test")


def test_a_clock_that_stands_still_for_good_is_refused() -> None:
    with pytest.raises(ConfigError, match="lets no run end; give for_s"):
        load_config(None, ["faults=[{unit: clock, kind: stuck, at_s: 0}]"])


def test_faults_are_set_on_the_command_line() -> None:
    config = load_config(None, ["faults=[{unit: camera, kind: off, at_s: 2}, {unit: bus, kind: ok}]"])
    assert [(f.unit, f.kind, f.at_s, f.for_s) for f in config.faults] == [
        ("camera", "off", 2.0, math.inf),
        ("bus", "ok", 0.0, math.inf),
    ]
    with pytest.raises(
        ConfigError, match=r"unknown configuration key 'faults\.0\.when'.*known here: unit, kind"
    ):
        load_config(None, ["faults=[{unit: camera, kind: stuck, when: 2}]"])


def test_faults_are_off_by_default() -> None:
    assert load_config().faults == ()
    assert Faults().active("camera", 10**18) == "ok"


@given(st.floats(0, 100), st.floats(0.001, 100), st.integers(0, 300_000_000_000), st.integers(0, 10**15))
def test_fault_lasts_for_its_duration(at_s: float, for_s: float, t_ns: int, start_ns: int) -> None:
    active = Faults([FaultConfig(unit="bus", kind="off", at_s=at_s, for_s=for_s)], start_ns)
    expected = round(at_s * 1e9) <= t_ns < round((at_s + for_s) * 1e9)
    assert (active.active("bus", start_ns + t_ns) == "off") == expected
    assert active.active("servo", start_ns + t_ns) == "ok"
    assert (active.end_ns("bus", start_ns + t_ns) > start_ns + t_ns) == expected


def test_ok_ends_a_fault() -> None:
    both = Faults([FaultConfig(unit="bus", kind="off"), FaultConfig(unit="bus", kind="ok", at_s=1.0)])
    assert [both.active("bus", t) for t in (0, 999_999_999, 1_000_000_000)] == ["off", "off", "ok"]


@pytest.mark.parametrize("kind", FAULTS["estimator"])
def test_estimator_fails_as_configured(kind: str, clock: Clock) -> None:
    estimator = FaultyEstimator(Two(), faults("estimator", kind), clock, lockstep=True)
    sound = estimator.update(GRAY)
    assert sound is not None
    assert sound.force_n == 2.0
    clock.sleep_until_ns(1_500_000_000)

    def outcome() -> object:
        try:
            estimate = estimator.update(GRAY)
        except RuntimeError:
            return "raises"
        return estimate if estimate is None else estimate.force_n

    seen = [outcome() for _ in range(6)]
    match kind:
        case "off":
            assert seen == ["raises"] * 6
        case "intermittent":
            assert seen == ["raises", 2.0] * 3 or seen == [2.0, "raises"] * 3
        case "stuck":
            assert seen == [None] * 6
        case "garbage":
            assert not any(math.isfinite(force) for force in seen)  # type: ignore[arg-type]
        case "wrong":
            assert seen == pytest.approx([2.0 * 2 / 3] * 6)
    clock.sleep_until_ns(2_000_000_000)
    sound = estimator.update(GRAY)
    assert sound is not None
    assert sound.force_n == 2.0


def test_estimator_blocks_in_real_time(clock: Clock) -> None:
    clock.sleep_until_ns(1_200_000_000)
    FaultyEstimator(Two(), faults("estimator", "stuck"), clock, lockstep=False).update(GRAY)
    assert clock.now_ns() == 2_000_000_000


@pytest.mark.parametrize("kind", FAULTS["disk"])
def test_disk_fails_as_configured(kind: str, clock: Clock) -> None:
    raw = io.BytesIO()
    file = FaultyFile(raw, faults("disk", kind), clock, lockstep=False)
    file.write(b"before")
    clock.sleep_until_ns(1_100_000_000)
    failures = []
    for _ in range(4):
        try:
            file.write(b"1234")
        except OSError as error:
            failures.append(error.errno)
    match kind:
        case "off":
            assert failures == [errno.ENOSPC] * 4
            assert raw.getvalue() == b"before" + 4 * b"12"
        case "slow":
            assert failures == []
            assert clock.now_ns() == 1_300_000_000
        case "intermittent":
            assert failures == [errno.EIO] * 2
    file.flush()
