"""Force error after the target is lowered during a hold, for the four objects of the paper and wrong friction.

    python scripts/lower_force.py

Each simulated gripper holds 5 N, and then gets the target 2 N. Prints the error of the load cell's force 0.5 s and 1 s
after the request, and the time until the new target counts as held. The simulated friction is 0.7, 1 and 1.4 times that
of the default gripper.
"""

import argparse
from collections.abc import Sequence

import numpy as np

import gripper_force as gf

OBJECTS = ("sponge", "paper_cup", "tube", "stapler")
FRICTIONS = (0.7, 1.0, 1.4)
LATE_S = (0.5, 1.0)
END_S = 2.5


def lower(keys: dict[str, object], before_n: float, after_n: float) -> tuple[list[float], float] | None:
    """Returns the relative errors at `LATE_S` and the time to `held` in s (infinite for never), or None.

    None means that the first force was not held.
    """
    with gf.open_gripper(overrides={"clock": "lockstep", "vision.threads": 1, **keys}) as gripper:
        if gripper.grasp(before_n).outcome != "held":
            return None
        begin_s, errors, held_s = gripper.state.t_ns / 1e9, list[float](), np.inf
        gripper.set_force(after_n, wait=False)
        while (now_s := gripper.state.t_ns / 1e9 - begin_s) < END_S:
            gripper.step()
            if len(errors) < len(LATE_S) and now_s >= LATE_S[len(errors)]:
                sample = gripper.load_cell
                errors.append(np.nan if sample is None else sample.force_n / after_n - 1)
            if np.isinf(held_s) and gripper.state.outcome == "held" and now_s > LATE_S[0]:
                held_s = now_s
        return errors, held_s


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints one line per object and feedback."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--feedback", nargs="+", default=["fused", "current"])
    parser.add_argument("--object", nargs="+", default=list(OBJECTS))
    parser.add_argument("--friction", nargs="+", type=float, default=list(FRICTIONS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--from-n", type=float, default=5.0)
    parser.add_argument("--to-n", type=float, default=2.0)
    given = parser.parse_args(arguments)
    heads = [
        "feedback",
        "object",
        "lowered",
        "error at 0.5 s: median, largest",
        "at 1 s",
        "held after s",
        "not held",
    ]
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for feedback in given.feedback:
        camera = {"camera.backend": "none"} if feedback == "current" else {}
        for name in given.object:
            cases = [
                lower(
                    {
                        "object": name,
                        "seed": seed,
                        "sim.friction": friction,
                        "control.feedback": feedback,
                        **camera,
                    },
                    given.from_n,
                    given.to_n,
                )
                for friction in given.friction
                for seed in range(1, given.seeds + 1)
            ]
            done = [case for case in cases if case is not None]
            if not done:
                print(f"| {feedback} | {name} | 0 of {len(cases)} | - | - | - | - |", flush=True)
                continue
            shares = np.abs([errors for errors, _ in done])  # (K, 2)
            held_s = np.array([time for _, time in done])
            early, late = (
                f"{100 * np.median(column):.1f}, {100 * column.max():.1f} %" for column in shares.T
            )
            print(
                f"| {feedback} | {name} | {len(done)} of {len(cases)} | {early} | {late} | {np.median(held_s):.2f} | "
                f"{np.isinf(held_s).sum()} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
