import pytest

from gripper_force.qualification.paper.models import MODELS, NETS, SCALES
from gripper_force.qualification.paper.paper_tables import COMPARISONS, MODELS_OF


@pytest.mark.parametrize("scale", SCALES.values(), ids=list(SCALES))
@pytest.mark.parametrize("net", NETS)
def test_recipes_of_networks_differ_only_in_the_network(net: str, scale: object) -> None:
    assert hasattr(scale, "recipe")
    recipe, plain = scale.recipe(net, 1), scale.recipe("plain", 1)
    apart = {key for key, value in recipe if value != getattr(plain, key)}
    assert apart <= {"attentions", "earlier_frames", "pooling", "backbone"}
    assert len(recipe.attentions) == 1


def test_networks_are_different() -> None:
    shapes = [SCALES["full"].recipe(net, 0).network(0) for net in NETS]
    assert len({str(shape) for shape in shapes}) == len(NETS)


def test_models_are_made_of_networks_and_tables_of_models() -> None:
    assert {net for nets in MODELS.values() for net in nets} == set(NETS)
    assert {model for models in MODELS_OF.values() for model in models} == set(MODELS)


def test_the_papers_ratios_follow_from_its_errors() -> None:
    printed = {
        0.03700: 109,
        0.03662: 111,
        0.03400: 119,
        0.03416: 119,
        0.03320: 122,
        0.03183: 127,
        0.03562: 114,
    }
    printed |= {0.03431: 118, 0.03311: 122, 0.03122: 130, 0.03769: 107, 0.03745: 108}
    rows = [row for _, rows in COMPARISONS.values() for row in rows]
    errors_n = {row.mae_n for row in rows if row.mae_n is not None}
    assert set(printed) | {0.04051, 0.03194} == errors_n
    for mae_n, percent in printed.items():
        assert 100 * 0.04051 / mae_n == pytest.approx(percent, abs=1.0)
