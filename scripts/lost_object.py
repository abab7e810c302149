"""Time until a lost object is reported as `slip`, for the four objects of the paper and several forces.

    python scripts/lost_object.py

The object of a simulated gripper vanishes during a hold. Prints the time to the outcome `slip`, median and largest, and
how many losses were reported within 50 ms.
"""

import argparse
from collections.abc import Sequence

import numpy as np

import gripper_force as gf

OBJECTS = ("sponge", "paper_cup", "tube", "stapler")
LOST_S = 6.0
MAX_S = 2.0
GOAL_MS = 50.0


def time_to_slip_ms(keys: dict[str, object], target_n: float) -> float | None:
    """Returns the time in ms (infinite for never), or None if the object was not held before."""
    lost = {"unit": "plant", "kind": "off", "at_s": LOST_S}
    overrides = {"clock": "lockstep", "vision.threads": 1, "faults": [lost], **keys}
    with gf.open_gripper(overrides=overrides) as gripper:
        if gripper.grasp(target_n).outcome != "held":
            return None
        # In lockstep, the clock begins with the run.
        while (now_s := gripper.state.t_ns / 1e9) < LOST_S + MAX_S:
            if gripper.state.outcome == "slip":
                return 1e3 * (now_s - LOST_S) if now_s >= LOST_S else None
            gripper.step()
        return np.inf


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints one line per feedback and force."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--feedback", nargs="+", default=["fused", "current"])
    parser.add_argument("--object", nargs="+", default=list(OBJECTS))
    parser.add_argument("--target-n", nargs="+", type=float, default=[1.0, 2.0, 5.0])
    parser.add_argument("--seeds", type=int, default=3)
    given = parser.parse_args(arguments)
    heads = [
        "feedback",
        "target",
        "lost",
        "`slip` after ms: median, largest",
        f"within {GOAL_MS:g} ms",
        "never",
    ]
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for feedback in given.feedback:
        camera = {"camera.backend": "none"} if feedback == "current" else {}
        for target_n in given.target_n:
            cases = [
                time_to_slip_ms(
                    {"object": name, "seed": seed, "control.feedback": feedback, **camera}, target_n
                )
                for name in given.object
                for seed in range(1, given.seeds + 1)
            ]
            times_ms = np.array([case for case in cases if case is not None], float)
            seen_ms = times_ms[np.isfinite(times_ms)]
            shown = f"{np.median(seen_ms):.0f}, {seen_ms.max():.0f}" if len(seen_ms) else "-"
            print(
                f"| {feedback} | {target_n:g} N | {len(times_ms)} of {len(cases)} | {shown} | "
                f"{np.count_nonzero(times_ms <= GOAL_MS)} | {np.count_nonzero(np.isinf(times_ms))} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
