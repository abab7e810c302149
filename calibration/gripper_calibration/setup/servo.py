"""Step ``servo``: shows the checks of `doctor` and sets the registers that survive power-off."""

from gripper_calibration.setup.step import Found, StepResult, Task
from gripper_force.errors import ConfigError
from gripper_force.jobs import doctor
from gripper_force.jobs.checks import RegisterChange

_FAST = 1_000_000


def servo(task: Task) -> StepResult:
    """Checks the gripper's servo, and changes each register to which the person agrees.

    Raises:
        ConfigError: A run needs a register to which the person did not agree.
        GripperError: See `doctor.setup`.
    """
    if task.config.servo.backend != "dynamixel":
        return StepResult(f"servo.backend={task.config.servo.backend} has no registers to check")
    if len(task.config.servo.ids) > 1:
        first, second = task.config.servo.ids
        results = [_set_up(task, first), _set_up(task, second)]
    else:
        results = [_set_up(task, task.config.servo.id)]
    written = [change for changes, _ in results for change in changes]
    values = {key: found for _, extra in results for key, found in extra.items()}
    config = task.config
    if "servo.baud_rate" in values:
        config = config.with_values(servo={"baud_rate": values["servo.baud_rate"].value})
    if "servo.homing_offset" in values:
        config = config.with_values(servo={"homing_offset": values["servo.homing_offset"].value})
    bad = [one for one in doctor.check_unit(config, "servo") if one.ok is False]
    remarks = [f"{one.unit}, {one.name}: {one.found}; {one.advice}" for one in bad]
    if bad:
        raise ConfigError(f"the servo is not ready for a run: {remarks[0]}")
    done = "; ".join(f"{one.register} {one.old} -> {one.new}" for one in written)
    summary = f"checked; {'written: ' + done if done else 'nothing to change'}"
    return StepResult(summary, values, remarks, details={"written": written})


def _set_up(task: Task, id_: int) -> tuple[list[RegisterChange], dict[str, Found]]:
    """Returns the changes that were written, and the keys that follow from those that were not."""
    servo_config = task.config.with_values(servo={"id": id_, "second": type(task.config.servo.second)()})
    written: list[RegisterChange] = []
    declined: list[RegisterChange] = []

    def asked(name: str, changes: list[RegisterChange]) -> bool:
        (change,) = changes
        text = f"{name}: {change.register.replace('_', ' ')} {change.old} -> {change.new}"
        agreed = task.person.agrees(f"{text}. Write it (EEPROM)?")
        (written if agreed else declined).append(change)
        return agreed

    doctor.setup(servo_config, asked, commission=True)
    values: dict[str, Found] = {}
    if any(one.register == "baud_rate" for one in written):
        values["servo.baud_rate"] = Found(_FAST, "written to the servo")
        task.keep(values)  # the servo answers at this rate only, whatever fails now
    for one in declined:
        if one.register == "homing_offset":
            values["servo.homing_offset"] = Found(int(one.old.split()[0]), "read from the servo")
        elif one.register != "baud_rate":
            raise ConfigError(
                f"{one.register} of servo {id_} stays {one.old}, but every run sets {one.new} before it turns torque "
                "on; run the step again and agree (setup --step servo), or use another servo"
            )
    return written, values
