from pathlib import Path

import numpy as np
import pytest

from gripper_force.errors import DataError
from gripper_force.jobs.imports.force_table import estimate_tare, read_forces

GRIP_N = np.interp(np.arange(60), [0, 15, 30, 45, 50, 60], [0, 0, 20, 20, 0, 0])
"""Nothing, a ramp, a hold, a fast release, nothing."""


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "lacks the column 'frame'"),
        ("frame,t_s\n0,0\n", "lacks the column 'force_n'"),
        (
            "frame;t_s;force_n\n0;0,0;1\n",
            "its first line is 'frame;t_s;force_n'; name columns frame, t_s and force_n, ",
        ),
        ("frame,t_s,force_n\n", "holds no rows"),
        ("frame,t_s,force_n\n0,0,1\n1,0.03,oops\n", "line 3: force_n is 'oops' and not a finite number"),
        ("frame,t_s,force_n\n0,0,nan\n", "line 2: force_n is 'nan' and not a finite number"),
        ("frame,t_s,force_n\n0,0\n", "line 2: force_n is None"),
        ("frame,t_s,force_n\n0.5,0,1\n", "line 2: frame is '0.5' and not a frame number"),
        ("frame,t_s,force_n\n1e19,0,1\n", "line 2: frame is '1e19' and not a frame number"),
        (
            "frame,t_s,force_n\n0,1.7e18,1\n",
            "line 2: t_s is '1.7e18', more than 100 years; write the times in",
        ),
        ("frame,t_s,force_n\n0,0,1\n0,0.03,1\n", "frame 0 at 0.0300 s follows frame 0 at"),
        ("frame,t_s,force_n\n0,0.03,1\n1,0,1\n", "frame 1 at 0.0000 s follows frame 0 at 0.0300 s"),
        ("\0\xff", "lacks the column"),
    ],
)
def test_malformed_table_raises_with_line(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "forces.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=r"forces\.csv") as caught:
        read_forces(path)
    assert sentence in str(caught.value)


def test_large_times_give_no_tare() -> None:
    tare_n, note = estimate_tare(np.array([1e18, 2e18]), np.array([0.0, 1.0]))
    assert tare_n == 0.0
    assert "too few" in note


def test_tare_needs_quiet_unloaded_start() -> None:
    t_s = np.arange(60) / 30
    tare_n, note = estimate_tare(t_s, GRIP_N + 0.55)
    assert tare_n == pytest.approx(0.55)
    assert note == ""
    for force_n, reason in [
        (GRIP_N + np.interp(t_s, [0, 0.3], [0, 3]), "contact may be near"),
        (GRIP_N[::-1] + np.interp(np.arange(60), [0, 40], [10, 0]), "contact may be near"),
        (np.interp(np.arange(60), [0, 20, 25], [6, 6, 0]), "may start loaded"),
        (np.full(60, 3.0), "never rises"),
        (GRIP_N[:2], "too few"),
    ]:
        tare_n, note = estimate_tare(t_s[: len(force_n)], force_n)
        assert tare_n == 0.0
        assert reason in note
