import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import ConfigError, GripperError
from gripper_force.qualification.paper.paper_page import NAMES, expand_name


def test_all_expands_to_everything() -> None:
    assert set(expand_name("all")) | {"all"} == set(NAMES)
    assert expand_name("fig8") == ("fig8",)
    with pytest.raises(ConfigError, match="can't reproduce '10'; choose from 3, 4"):
        expand_name("10")


def test_reproduce_makes_a_figure_and_writes_it_into_a_page(touches: Path, tmp_path: Path) -> None:
    page = tmp_path / "paper.md"
    places = ("small", "small fig8", "small 3")
    page.write_text("# Paper\n" + "".join(f"<!-- {p} -->\nold {p}\n<!-- end of {p} -->\n" for p in places))
    options = ["--data", str(touches), "--out", str(tmp_path / "out"), "--write", str(page), "--jobs", "1"]
    for key in ("size=32", "width=0.25", "steps=2", "seeds=1"):
        options += ["--set", key]
    done = CliRunner().invoke(cli.app, ["reproduce", "fig8", "--json", *options])
    assert done.exit_code == 0, done.stderr
    picture = tmp_path / "paper" / "fig8.png"
    assert json.loads(done.stdout)["figures"] == {"fig8": str(picture)}
    assert picture.stat().st_size > 10_000
    text = page.read_text()
    assert "(paper/fig8.png)" in text
    assert "old small 3" in text
    assert text.count("old") == 1
    assert "32x32 pixels, width 0.25, 2 steps per network, 1 seeds" in text


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["10"], "can't reproduce '10'"),
        (["3", "--scale", "huge"], "no scale 'huge'; choose from small, full"),
        (["3", "--set", "sise=3"], "sise"),
        (["3", "--data", "nowhere", "--out", "OUT"], "no logs in nowhere/train"),
    ],
)
def test_bad_input_raises(arguments: list[str], sentence: str, tmp_path: Path) -> None:
    arguments = [str(tmp_path) if part == "OUT" else part for part in arguments]
    done = CliRunner().invoke(cli.app, ["reproduce", *arguments])
    assert isinstance(done.exception, GripperError)
    assert sentence in str(done.exception)
