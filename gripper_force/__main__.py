"""``python -m gripper_force`` is the ``gripper-force`` command."""

from gripper_force.cli import main

main()
