"""Vocabulary of injected faults: units, kinds, and the `faults` key of the configuration."""

from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from gripper_force.schema import NonNegative, Section

FAULTS: Final[dict[str, dict[str, str]]] = {
    "servo": {
        "off": "no power; after its return the RAM registers are reset",
        "stuck": "Bus Watchdog tripped",
        "wrong": "reports an overload error",
        "intermittent": "no power for 5 ms every 0.3 s",
    },
    "bus": {
        "off": "adapter unplugged",
        "garbage": "every reply is corrupted",
        "wrong": "every reply carries another id",
        "slow": "every reply arrives after the driver's timeout",
        "delayed": "every reply belongs to the previous request",
        "intermittent": "half of the replies are lost",
    },
    "plant": {
        "off": "the object leaves the jaws for good, whatever the duration",
        "wrong": "motor current exceeds its goal, by another 50 % every second",
    },
    "camera": {
        "off": "no frames",
        "stuck": "the last image is repeated",
        "garbage": "every pixel is noise",
        "wrong": "six times as much light",
        "slow": "5 frames per second",
        "delayed": "every frame arrives 0.3 s late",
        "intermittent": "four of five frames are lost",
    },
    "load_cell": {
        "off": "no samples",
        "stuck": "the last reading is repeated",
        "garbage": "random readings within 200 N, or not finite",
        "wrong": "reads its full scale",
        "slow": "2 samples per second",
        "delayed": "every sample arrives 0.5 s late",
        "intermittent": "no samples in every second period of 0.3 s",
    },
    "estimator": {
        "off": "raises an exception",
        "stuck": "hangs",
        "garbage": "estimates are not finite",
        "wrong": "estimates are a third too low",
        "intermittent": "raises an exception at every second frame",
    },
    "clock": {
        "stuck": "the process is stopped, as by SIGSTOP",
        "wrong": "the wall clock jumps back by one day",
        "slow": "every cycle starts 15 ms late",
    },
    "disk": {
        "off": "full: every write fails",
        "slow": "every write takes 50 ms",
        "intermittent": "every second write fails",
    },
}
"""Faults that can be injected, in the vocabulary of PX4
(https://docs.px4.io/main/en/debug/failure_injection.html): unit, kind, and its meaning."""


class FaultConfig(Section):
    """A fault to inject; `FAULTS` lists units, kinds and their meaning."""

    unit: Literal["servo", "bus", "plant", "camera", "load_cell", "estimator", "clock", "disk"]
    kind: Literal["ok", "off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
    at_s: NonNegative = Field(0.0, description="start, seconds after the start of the run")
    for_s: Annotated[float, Field(gt=0)] = Field(float("inf"), description="duration in seconds")
    id: int | None = Field(
        None, description="servo, plant (not off): id of the only servo that fails; None: all on the bus"
    )

    @model_validator(mode="after")
    def _is_supported(self) -> Self:
        if self.kind != "ok" and self.kind not in FAULTS[self.unit]:
            known = ", ".join(("ok", *FAULTS[self.unit]))
            raise ValueError(f"unit {self.unit} has no fault kind {self.kind}; choose one of {known}")
        if self.id is not None and self.unit != "servo" and (self.unit != "plant" or self.kind == "off"):
            raise ValueError(f"kind {self.kind} of unit {self.unit} has no id; leave it out")
        if (self.unit, self.kind) == ("clock", "stuck") and self.for_s == float("inf"):
            raise ValueError("a clock that stands still for good lets no run end; give for_s")
        return self
