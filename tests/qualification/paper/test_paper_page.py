import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import ConfigError, GripperError
from gripper_force.qualification.paper import experiment
from gripper_force.qualification.paper.paper_page import NAMES, expand_name


def test_all_expands_to_everything() -> None:
    assert set(expand_name("all")) | {"all"} == set(NAMES)
    assert expand_name("fig8") == ("fig8",)
    with pytest.raises(ConfigError, match="can't reproduce '10'; choose from 3, 4"):
        expand_name("10")


@pytest.mark.usefixtures("one_thread")
def test_reproduce_makes_a_figure_and_writes_it_into_a_page(
    touches: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thread_pool: object
) -> None:
    page = tmp_path / "paper.md"
    places = ("redrawn small", "redrawn small fig8", "redrawn small 3")
    page.write_text("# Paper\n" + "".join(f"<!-- {p} -->\nold {p}\n<!-- end of {p} -->\n" for p in places))
    options = ["--data", str(touches), "--out", str(tmp_path / "out"), "--write", str(page), "--jobs", "1"]
    options += [
        "--instances",
        "redrawn",
        "--steps",
        "1,2",
        "--seeds",
        "1",
        "--set",
        "size=32",
        "--set",
        "width=0.25",
    ]
    early = CliRunner().invoke(cli.app, ["reproduce", "fig8", "--json", "--minutes", "0", *options])
    assert early.exit_code == 0, early.stderr
    assert "2 networks are not trained yet; run the same command again to continue" in early.stderr
    assert json.loads(early.stdout)["figures"] == {}
    assert "fig8.png" not in page.read_text()
    assert "not measured" in page.read_text()
    monkeypatch.setattr(experiment, "process_pool", thread_pool)
    done = CliRunner().invoke(cli.app, ["reproduce", "fig8", "--json", *options])
    assert done.exit_code == 0, done.stderr
    assert "training: 3 of 3, ssam-1, seed 0, 2 steps; 0.0 h left" in done.stderr
    picture = tmp_path / "paper" / "redrawn-small-fig8.png"
    printed = json.loads(done.stdout)
    assert printed["figures"] == {"fig8": str(picture)}
    assert (printed["steps"], printed["seeds"], printed["missing"]) == ([1, 2], 1, "")
    assert picture.stat().st_size > 10_000
    text = page.read_text()
    assert "(paper/redrawn-small-fig8.png)" in text
    assert "old redrawn small 3" in text
    assert text.count("old") == 1
    assert "32x32 pixels, width 0.25." in text


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["10"], "can't reproduce '10'"),
        (["3", "--scale", "huge"], "no scale 'huge'; choose from small, full"),
        (["3", "--set", "sise=3"], "sise"),
        (["3", "--steps", "1100,many"], "steps"),
        (["3", "--instances", "other"], "instances"),
        (["3", "--data", "nowhere", "--out", "OUT"], "no logs in nowhere/train"),
    ],
)
def test_bad_input_raises(arguments: list[str], sentence: str, tmp_path: Path) -> None:
    arguments = [str(tmp_path) if part == "OUT" else part for part in arguments]
    done = CliRunner().invoke(cli.app, ["reproduce", *arguments])
    assert isinstance(done.exception, GripperError)
    assert sentence in str(done.exception)
