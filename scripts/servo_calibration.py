"""Coverage of the intervals of `gripper-force calibrate servo`, over simulated rigs.

    python scripts/servo_calibration.py --seeds 100

Motor, friction and gear play differ from rig to rig. A 95 % interval should contain 95 of 100 true values.
"""

import argparse

from gripper_calibration.fits.servo_fit import Nominal, fit_servo
from gripper_calibration.procedures.servo_measurement import measure
from gripper_force.config import load_config
from gripper_force.runtime.resolve import resolve
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.sim.objects import BLOCK_WIDTH_M
from gripper_hw.sim.scene import draw_scene


def main() -> None:
    """Prints the errors of each rig in half intervals, and the coverage of each parameter."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=0)
    arguments = parser.parse_args()
    held: dict[str, list[float]] = {}
    widths: dict[str, list[float]] = {}
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
        config = load_config(
            None, ["object=block", "camera.backend=none", "sim.detail=coarse", f"seed={seed}"]
        )
        presses, passes = measure(resolve(config, vision=False).config, BLOCK_WIDTH_M)
        gripper = config.gripper
        fit = fit_servo(presses, passes, Nominal(gripper.pinion_radius_m, gripper.open_width_m))
        scene, radius_m = draw_scene("block", seed, config.sim), gripper.pinion_radius_m
        nm_per_a = load_model(config.servo.model).nm_per_a * scene.nm_per_a
        friction_n = scene.servo_friction_nm / (2 * radius_m) + scene.jaw_friction_n
        truth = {
            "nm_per_a": nm_per_a,
            "friction_n": friction_n,
            "free_friction_n": friction_n,
            "friction_share": 0.0,
            # The viscous friction of the rails is 2 N s/m in every scene.
            "damping_n_s_m": scene.servo_damping_nm_s / (2 * radius_m**2) + 2.0,
            # Open is 0 rad; while closing, the pinion leads the rack by half of the gear play.
            "open_position_rad": scene.backlash_m / radius_m,
        }
        line = []
        for name, true in truth.items():
            found = getattr(fit, name)
            held.setdefault(name, []).append((found.value - true) / found.half)
            widths.setdefault(name, []).append(found.half)
            line.append(f"{name} {held[name][-1]:+.2f}")
        print(f"seed {seed}: {', '.join(line)}", flush=True)
    for name, errors in held.items():
        inside = sum(abs(error) <= 1 for error in errors)
        mean = sum(errors) / len(errors)
        half = sorted(widths[name])[len(errors) // 2]
        print(
            f"{name}: {inside} of {len(errors)} inside, mean error {mean:+.2f} half intervals of {half:.3g}"
        )


if __name__ == "__main__":
    main()
