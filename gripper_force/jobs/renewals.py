"""New references of a run: the frames of its log before which the estimator took one."""

from gripper_force.control.state_machine import refused_ns
from gripper_force.types import Event, Frame, Record, Request


class RenewalFinder:
    """Finds the frames that were the first ones with a new reference, from a log's records in their order."""

    def __init__(self) -> None:
        self._renewal_ns: int | None = None

    def is_renewed(self, record: Record) -> bool:
        """Takes the next record. Returns True for the first frame that a run compared with a new reference."""
        if isinstance(record, Request) and record.new_object:
            self._renewal_ns = record.t_ns
        elif isinstance(record, Event) and self._renewal_ns in refused_ns([record]):
            self._renewal_ns = None
        elif isinstance(record, Frame) and self._renewal_ns is not None and record.t_ns > self._renewal_ns:
            self._renewal_ns = None
            return True
        return False
