"""Lines of `setup`: what a step found."""

from typing import TYPE_CHECKING

from gripper_force.cli.console import err

if TYPE_CHECKING:  # --help loads no NumPy
    from gripper_calibration.setup.run import StepReport


def step_lines(report: "StepReport") -> None:
    """Prints what became of a step, on stderr."""
    if report.result == "kept":
        err.print(f"{report.name}: finished before: {report.summary}", soft_wrap=True, markup=False)
    else:
        err.print(f"  {report.summary}", soft_wrap=True, markup=False)
    for remark in report.remarks:  # also those of a kept step: what it did not find is still missing
        err.print(f"  - {remark}", soft_wrap=True, markup=False)
    if report.result == "kept":
        return
    for what, path in report.files.items():
        err.print(f"  {what}: {path}", soft_wrap=True, markup=False)
