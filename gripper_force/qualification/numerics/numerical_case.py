"""Result of one hard numerical case."""

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class NumericalCase:
    """One hard case.

    Attributes:
        case: Name of the case.
        detail: Inputs, and what the figure is compared with.
        figure: Measured value. NaN exceeds any bound.
        bound: Largest allowed figure; infinite if the case is informative only.
        unit: Unit of both.
        ok: True if the figure is within its bound.
    """

    case: str
    detail: str
    figure: float
    bound: float
    unit: str = ""
    ok: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "ok", bool(self.figure <= self.bound))
