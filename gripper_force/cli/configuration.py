"""Commands for configuration files: show, check, schema, file."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gripper_force.cli import console
from gripper_force.cli.options import AsJson, ConfigPath, NoOverrides, Overrides, load_settings
from gripper_force.errors import ConfigError

if TYPE_CHECKING:  # --help loads no NumPy
    from gripper_force.config import Config
    from gripper_force.types import Gray

app = typer.Typer(help="Show, check or describe the configuration.", no_args_is_help=True)


@app.command()
def show(config: ConfigPath = None, set_: Overrides = None, as_json: AsJson = False) -> None:
    """Print the complete configuration as YAML: defaults, rig profile, file and --set combined."""
    from gripper_force.config import dump_config

    settings = load_settings(config, set_, {})
    console.show(settings.model_dump(mode="json"), as_json, lambda _: sys.stdout.write(dump_config(settings)))


@app.command()
def check(config: ConfigPath = None, set_: Overrides = None, as_json: AsJson = False) -> None:
    """Check keys, values, profiles, backends, network, budgets and simulated scene without opening a real device."""
    from gripper_force.runtime.backends import check_devices, is_simulated, open_devices
    from gripper_force.runtime.resolve import make_estimator, resolve

    resolved = resolve(load_settings(config, set_, {}))
    resolved.check_target(resolved.config.target_n)
    check_devices(resolved.config)
    make_estimator(resolved)
    gray = _known_frame(resolved.config)
    if is_simulated(resolved.config):
        with open_devices(resolved.config):
            pass
    if gray is not None and resolved.config.uses_vision:
        from gripper_force.vision.preprocess import downscale

        downscale(gray, resolved.config.vision.region, 1)  # raises if the region reaches beyond the frame
    notes = [text for _, text in resolved.notes]
    result = {"ok": True, "choices": list(resolved.choices), "notes": notes}
    console.show(result, as_json, lambda _: console.out.print("\n".join(["ok", *notes])))


def _known_frame(config: "Config") -> "Gray | None":
    """Returns a frame of a camera that need not be opened for its size; None for another one."""
    import numpy as np

    from gripper_force.runtime.log_reader import LogReader
    from gripper_force.types import Frame

    camera = config.camera
    if camera.backend in ("oak", "uvc"):
        return np.zeros((camera.side_px, camera.side_px), np.uint8)
    if camera.backend == "simulated":
        from gripper_hw.sim.simulated_rig import FRAME_SIDE_PX

        return np.zeros((FRAME_SIDE_PX, FRAME_SIDE_PX), np.uint8)
    if camera.backend == "playback" and camera.path is not None:
        return next((frame.gray for frame in LogReader(camera.path).records(Frame)), None)
    return None


@app.command()
def schema(set_: Overrides = None, as_json: AsJson = False) -> None:
    """Print the JSON schema of configuration files, for completion and checks in editors."""
    import json

    from gripper_force.config import Config

    load_settings(None, set_, {})
    tree = Config.model_json_schema()
    console.show(tree, as_json, lambda _: sys.stdout.write(json.dumps(tree, indent=2) + "\n"))


@app.command()
def file(
    name: Annotated[str | None, typer.Argument(help="Name of a file. Default: list all.")] = None,
    set_: NoOverrides = None,
    as_json: AsJson = False,
) -> None:
    """Print a file that comes with the package: an example, the udev rules, or the layout for Foxglove."""
    files = shipped_files()
    if name is None:
        console.show({key: str(path) for key, path in files.items()}, as_json, console.pairs)
    elif name not in files:
        raise ConfigError(f"no file {name!r} comes with gripper-force; use one of: {', '.join(files)}")
    elif as_json:
        console.show({"path": str(files[name])}, as_json)
    else:
        sys.stdout.buffer.write(files[name].read_bytes())


def shipped_files() -> dict[str, Path]:
    """Returns the files by name. A wheel has them in the package, a clone beside it."""
    from gripper_force.jobs.view import FOXGLOVE_LAYOUT
    from gripper_hw import UDEV_RULES

    package = Path(__file__).parents[1]
    examples = next(folder for base in (package, package.parent) if (folder := base / "examples").is_dir())
    paths = [path for path in sorted(examples.rglob("*")) if path.suffix in (".yaml", ".xml", ".stl")]
    return {path.name: path for path in (*paths, UDEV_RULES, FOXGLOVE_LAYOUT)}
