"""Force error after the target is lowered during a hold, for the four objects of the paper and wrong friction.

    python scripts/lower_force.py

Each simulated gripper holds 5 N, and then gets the target 2 N. Prints the error of the load cell's force 0.5 s and 1 s
after the request, and the time until the new target counts as held. For comparison, it also prints the error of a
grasp that gets the lower target at once. The simulated friction is 0.7, 1 and 1.4 times that of the default gripper.
"""

import argparse
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

import gripper_force as gf

OBJECTS = ("sponge", "paper_cup", "tube", "stapler")
FRICTIONS = (0.7, 1.0, 1.4)
LATE_S = (0.5, 1.0)
END_S = 2.5


def lower(keys: dict[str, object], before_n: float, after_n: float) -> tuple[list[float], float] | None:
    """Returns the relative errors at `LATE_S` and the time to `held` in s (infinite for never), or None.

    None means that the first force was not held.
    """
    with _open(keys) as gripper:
        if gripper.grasp(before_n).outcome != "held":
            return None
        begin_s, errors, held_s = gripper.state.t_ns / 1e9, list[float](), np.inf
        gripper.set_force(after_n, wait=False)
        while (now_s := gripper.state.t_ns / 1e9 - begin_s) < END_S:
            gripper.step()
            if len(errors) < len(LATE_S) and now_s >= LATE_S[len(errors)]:
                errors.append(_error(gripper, after_n))
            if np.isinf(held_s) and gripper.state.outcome == "held" and now_s > LATE_S[0]:
                held_s = now_s
        return errors, held_s


def grasp(keys: dict[str, object], target_n: float) -> float:
    """Returns the relative error of a grasp as it is held; NaN if it is not."""
    with _open(keys) as gripper:
        return _error(gripper, target_n) if gripper.grasp(target_n).outcome == "held" else np.nan


def _open(keys: dict[str, object]) -> gf.Gripper:
    return gf.open_gripper(overrides={"clock": "lockstep", "vision.threads": 1, **keys})


def _error(gripper: gf.Gripper, target_n: float) -> float:
    sample = gripper.load_cell
    return np.nan if sample is None else sample.force_n / target_n - 1


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
        "grasped at once",
    ]
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for feedback in given.feedback:
        camera = {"camera.backend": "none"} if feedback == "current" else {}
        for name in given.object:
            grippers: list[dict[str, object]] = [
                {
                    "object": name,
                    "seed": seed,
                    "sim.friction": friction,
                    "control.feedback": feedback,
                    **camera,
                }
                for friction in given.friction
                for seed in range(1, given.seeds + 1)
            ]
            cases = [lower(keys, given.from_n, given.to_n) for keys in grippers]
            done = [case for case in cases if case is not None]
            if not done:
                print(f"| {feedback} | {name} | 0 of {len(cases)} | - | - | - | - | - |", flush=True)
                continue
            shares = np.abs([errors for errors, _ in done])  # (K, 2)
            held_s = np.array([time for _, time in done])
            early, late = (_median_and_largest(column) for column in shares.T)
            at_once = np.abs([grasp(keys, given.to_n) for keys in grippers])
            held = at_once[~np.isnan(at_once)]
            shown = f"{_median_and_largest(held) if held.size else '-'} ({held.size} of {at_once.size})"
            print(
                f"| {feedback} | {name} | {len(done)} of {len(cases)} | {early} | {late} | {np.median(held_s):.2f} | "
                f"{np.isinf(held_s).sum()} | {shown} |",
                flush=True,
            )


def _median_and_largest(shares: npt.NDArray[np.float64]) -> str:
    return f"{100 * np.median(shares):.1f}, {100 * shares.max():.1f} %"


if __name__ == "__main__":
    main()
