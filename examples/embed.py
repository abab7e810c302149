"""Grasps with 3 N, raises to 5 N, lowers to 2 N and releases, while a thread reads the force at its own rate.

Give the path of your configuration, or nothing for the simulated rig.
"""

import contextlib
import sys
import threading
import time

import gripper_force as gf


def print_forces(gripper: gf.Gripper) -> None:
    with contextlib.suppress(gf.RequestError):  # raised once the gripper is closed
        while True:
            print(f"{gripper.force_n:.2f} N at {gripper.width_m * 1e3:.1f} mm, {gripper.state.phase}")
            time.sleep(0.1)


with gf.open_gripper(*sys.argv[1:2]) as gripper:
    threading.Thread(target=print_forces, args=(gripper,), daemon=True).start()
    print(gripper.grasp(3.0))
    print(gripper.set_force(5.0))
    print(gripper.set_force(2.0))
    gripper.release()
