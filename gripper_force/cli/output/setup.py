"""Lines of `setup`: what a step found, and the end."""

from pathlib import Path
from typing import TYPE_CHECKING

from gripper_force.cli.console import err, out

if TYPE_CHECKING:  # --help loads no NumPy
    from gripper_calibration.setup.run import StepReport


def step_lines(report: "StepReport") -> None:
    """Prints what became of a step, on stderr."""
    if report.result == "kept":
        err.print(f"{report.name}: finished before: {report.summary}", soft_wrap=True, markup=False)
        return
    err.print(f"  {report.summary}", soft_wrap=True, markup=False)
    for remark in report.remarks:
        err.print(f"  - {remark}", soft_wrap=True, markup=False)
    for what, path in report.files.items():
        err.print(f"  {what}: {path}", soft_wrap=True, markup=False)


def setup_report(rig: Path, next_command: str) -> None:
    """Prints the rig file and the next command."""
    out.print(f"rig file: {rig}", soft_wrap=True, markup=False)
    out.print(f"next: {next_command}", soft_wrap=True, markup=False)
