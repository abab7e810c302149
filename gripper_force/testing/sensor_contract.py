"""Fixtures and checks that the contracts of cameras and load cells share."""

import time
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Final, Protocol, TypeVar

import pytest

from gripper_force.errors import DeviceError
from gripper_force.interfaces import Clock
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.types import NS_PER_S

_TIMEOUT_S: Final = 60.0
"""Longest time on the host's clock until the wanted items must be there."""

_POLL_S = 0.002


class _Sensor(Protocol):
    def start(self) -> None: ...


S = TypeVar("S", bound=_Sensor)
T = TypeVar("T")


class SensorContract:
    """Fixtures of both contracts. Override `clock` if the sensor is not on the host's clock."""

    @pytest.fixture
    def clock(self) -> Clock:
        """The clock of the sensor's times."""
        return MonotonicClock()

    @pytest.fixture
    def wait(self, clock: Clock) -> Callable[[float], None]:
        """Lets this many seconds pass for the sensor. Override it to make the device produce items."""
        return lambda seconds: clock.sleep_until_ns(clock.now_ns() + round(seconds * NS_PER_S))


def collect(receive: Callable[[], Sequence[T]], count: int, wait: Callable[[float], None]) -> list[T]:
    """Waits for at least ``count`` items of a sensor and returns them."""
    items: list[T] = []
    deadline_s = time.monotonic() + _TIMEOUT_S
    while len(items) < count:
        assert time.monotonic() < deadline_s, f"{len(items)} of {count} items within {_TIMEOUT_S:g} s"
        if new := receive():
            items += new
        else:
            wait(_POLL_S)
    return items


def check_counts(counts: Sequence[Mapping[str, int]]) -> None:
    """Checks successive results of ``counts``: causes with numbers that never decrease."""
    for count in counts:
        assert all(type(cause) is str and type(number) is int for cause, number in count.items())
        assert all(number >= 0 for number in count.values())
    for older, newer in pairwise(counts):
        assert all(newer.get(cause, 0) >= number for cause, number in older.items())


def check_second_object(first: S, second: S | None, receive: Callable[[S, int], object]) -> None:
    """Checks that a second object for the same device works, or its ``start`` raises, and the first one works."""
    if second is None:
        pytest.skip("the fixture of the second object is not overridden")
    first.start()
    receive(first, 1)
    try:
        second.start()
    except DeviceError:
        pass
    else:
        receive(second, 2)
    receive(first, 2)
