"""Candidate corrections of one object: none, a line, curves, and a line with the last layer refitted."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from gripper_calibration.fits.output_curve import BENDS, CurveProblem, LineEvidence, fit_line, identity
from gripper_calibration.fits.ridge import PENALTIES, Ridge
from gripper_calibration.fits.touches import Floats, Touches
from gripper_force.profiles.object_profile import OutputCurve


class Candidate(NamedTuple):
    """One kind of correction.

    Attributes:
        name: Name for a person; a key of the command's output.
        curve: Correction of the output: ``identity``, ``affine``, or one of `BENDS`.
        penalty: Penalty of the last layer's refit, one of `PENALTIES`; None for no refit.
    """

    name: str
    curve: str | float
    penalty: float | None


class FittedCandidate(NamedTuple):
    """A fitted correction.

    Attributes:
        output: Correction of the output.
        head: Correction of the last layer's weights, (F,); None for no refit.
        offset_n: Constant part of the last layer's correction.
    """

    output: OutputCurve
    head: Floats | None
    offset_n: float

    def predict(self, touches: Touches) -> Floats:
        """Returns the corrected forces, (N,)."""
        force_n = self.output.at(touches.estimate_n)
        return force_n if self.head is None else force_n + touches.features @ self.head + self.offset_n


def fit_candidates(
    touches: Touches,
    candidates: Sequence[Candidate],
    max_frames: int,
    evidence: Mapping[int, LineEvidence] | None = None,
) -> Iterator[FittedCandidate]:
    """Fits candidates to touches.

    Args:
        touches: One or more touches.
        candidates: The candidates.
        max_frames: Frames for a refit of the last layer, whose cost is cubic.
        evidence: `line_evidence` of these touches, and perhaps of others, if it is known.

    Yields:
        The fit of each candidate.
    """
    line = fit_line(touches, evidence)
    max_estimate_n = float(touches.estimate_n.max())
    ridge: Ridge | None = None
    problem: CurveProblem | None = None
    for candidate in candidates:
        if candidate.curve == "identity":
            output = identity(max_estimate_n)
        elif candidate.curve == "affine":
            output = line.curve(max_estimate_n)
        else:
            problem = problem or CurveProblem(touches, line)
            output = problem.solve(float(candidate.curve))
        if candidate.penalty is None:
            yield FittedCandidate(output, None, 0.0)
            continue
        if ridge is None:
            thin = touches.thinned(max_frames)
            ridge, residual_n = Ridge(thin.features), thin.force_n - line.predict(thin.estimate_n)
        yield FittedCandidate(output, *ridge.solve(residual_n, candidate.penalty))


def _candidates() -> list[Candidate]:
    curves: list[tuple[str, str | float]] = [("a line", "affine")]
    curves += [(f"a curve (bend {bend:g})", bend) for bend in BENDS]
    alone = [Candidate("the network as it is", "identity", None), *(Candidate(n, c, None) for n, c in curves)]
    # The last layer corrects what is not linear, so it is combined with the line only.
    heads = [Candidate(f"a line, and the last layer ({p:.0e})", "affine", float(p)) for p in PENALTIES]
    return alone + heads


CANDIDATES: Final = _candidates()
"""All candidates, from the simplest."""

AS_IT_IS: Final = CANDIDATES[0]
"""No correction."""

LINE: Final = next(c for c in CANDIDATES if c.curve == "affine" and c.penalty is None)
"""The correction with too few touches for a choice."""
