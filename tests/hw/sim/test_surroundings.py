import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gripper_hw.sim.scene import Scene
from gripper_hw.sim.surroundings import Surroundings

SEEDS = st.integers(0, 2**31 - 1)
TIMES_S = st.floats(0, 1e4)


@given(SEEDS, TIMES_S)
def test_light_varies_by_30_percent_at_most_and_background_stays_behind_the_object(
    seed: int, t_s: float
) -> None:
    scene = Scene("tube", "coarse", table_seed=seed, changing_light=True, moving_background=True)
    surroundings = Surroundings(scene)
    assert 0.7 <= surroundings.light_factor(t_s) <= 1.3
    x, y, z = surroundings.positions_m(t_s).T
    assert (np.abs(x) <= 0.12).all()
    assert ((y >= 0.1) & (y <= 0.24)).all()
    assert ((z >= 0) & (z <= 0.08)).all()
    assert (Surroundings(scene).positions_m(t_s) == surroundings.positions_m(t_s)).all()


@given(SEEDS)
def test_light_and_background_keep_changing(seed: int) -> None:
    surroundings = Surroundings(
        Scene("tube", "coarse", table_seed=seed, changing_light=True, moving_background=True)
    )
    times_s = np.linspace(0, 10, 200)  # a period of the slowest
    assert np.ptp([surroundings.light_factor(t_s) for t_s in times_s]) > 0.01
    assert (np.ptp([surroundings.positions_m(t_s) for t_s in times_s], axis=0) > 0.01).all()


@given(SEEDS, TIMES_S)
def test_surroundings_are_constant_by_default(seed: int, t_s: float) -> None:
    surroundings = Surroundings(Scene("tube", "coarse", table_seed=seed))
    assert surroundings.light_factor(t_s) == 1.0
    assert len(surroundings.positions_m(t_s)) == 0
