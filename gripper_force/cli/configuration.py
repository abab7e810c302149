"""Commands for configuration files: show, check, schema."""

import sys

import typer

from gripper_force.cli import console
from gripper_force.cli.options import AsJson, ConfigPath, Overrides, load_settings

app = typer.Typer(help="Show, check or describe the configuration.", no_args_is_help=True)


@app.command()
def show(config: ConfigPath = None, set_: Overrides = None, as_json: AsJson = False) -> None:
    """Print the complete configuration as YAML: defaults, rig profile, file and --set combined."""
    from gripper_force.config import dump_config

    settings = load_settings(config, set_, {})
    console.show(settings.model_dump(mode="json"), as_json, lambda _: sys.stdout.write(dump_config(settings)))


@app.command()
def check(config: ConfigPath = None, set_: Overrides = None, as_json: AsJson = False) -> None:
    """Check keys, values, profiles, backends, network and budgets without opening a device."""
    from gripper_force.runtime.backends import check_devices
    from gripper_force.runtime.resolve import make_estimator, resolve

    run = resolve(load_settings(config, set_, {}))
    run.check_target(run.config.target_n)
    check_devices(run.config)
    make_estimator(run)
    notes = [text for _, text in run.notes]
    result = {"ok": True, "choices": list(run.choices), "notes": notes}
    console.show(result, as_json, lambda _: console.out.print("\n".join(["ok", *notes])))


@app.command()
def schema(set_: Overrides = None, as_json: AsJson = False) -> None:
    """Print the JSON schema of configuration files, for completion and checks in editors."""
    import json

    from gripper_force.config import Config

    load_settings(None, set_, {})
    tree = Config.model_json_schema()
    console.show(tree, as_json, lambda _: sys.stdout.write(json.dumps(tree, indent=2) + "\n"))
