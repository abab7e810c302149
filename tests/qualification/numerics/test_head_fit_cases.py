from decimal import Decimal

import numpy as np
import pytest

from gripper_calibration.fits.ridge import Ridge
from gripper_calibration.fits.touches import Floats
from gripper_force.qualification.numerics import head_fit_cases as conditioning


def test_every_case_is_within_its_bound() -> None:
    rows = list(conditioning.cases())
    assert [row.case for row in rows if not row.ok] == []
    assert len({row.case for row in rows}) == len(rows)


@pytest.mark.parametrize("share", [1e-9, np.nan])
def test_a_small_error_of_the_fit_is_found(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    right = Ridge.solve

    def wrong(self: Ridge, missing_n: Floats, penalty: float) -> tuple[Floats, float]:
        weights, offset_n = right(self, missing_n, penalty)
        return weights * (1 + share), offset_n

    monkeypatch.setattr(Ridge, "solve", wrong)
    rows = conditioning.cases()
    assert not next(row for row in rows if row.case == "last layer fitted to ordinary frames").ok


def test_the_reference_solves_a_linear_system() -> None:
    matrix = [[Decimal(4), Decimal(1)], [Decimal(1), Decimal(3)]]
    assert conditioning._solved(matrix, [Decimal(6), Decimal(7)]) == [Decimal(1), Decimal(2)]
