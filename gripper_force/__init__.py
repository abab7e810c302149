"""Grip force control from camera images, for Dynamixel grippers.

Every name below is public and covered by semantic versioning. A name is imported when it is first used, so
``import gripper_force`` is fast and loads no heavy package.

Example::

    import gripper_force as gf

    with gf.open_gripper("my.yaml", log="run.mcap") as gripper:
        result = gripper.grasp(4.0)
        gripper.release()
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gripper_calibration.procedures.calibrate_object import ObjectCalibration as ObjectCalibration
    from gripper_calibration.procedures.calibrate_object import calibrate_object as calibrate_object
    from gripper_calibration.procedures.teach import Taught as Taught
    from gripper_calibration.procedures.teach import teach as teach
    from gripper_force.config import CameraConfig as CameraConfig
    from gripper_force.config import Config as Config
    from gripper_force.config import LoadCellConfig as LoadCellConfig
    from gripper_force.config import ServoConfig as ServoConfig
    from gripper_force.config import load_config as load_config
    from gripper_force.errors import CheckpointError as CheckpointError
    from gripper_force.errors import ConfigError as ConfigError
    from gripper_force.errors import DataError as DataError
    from gripper_force.errors import DeviceError as DeviceError
    from gripper_force.errors import DeviceLostError as DeviceLostError
    from gripper_force.errors import DeviceNotFoundError as DeviceNotFoundError
    from gripper_force.errors import DeviceTimeoutError as DeviceTimeoutError
    from gripper_force.errors import GripperError as GripperError
    from gripper_force.errors import HardwareFaultError as HardwareFaultError
    from gripper_force.errors import LogError as LogError
    from gripper_force.errors import NonFiniteError as NonFiniteError
    from gripper_force.errors import RequestError as RequestError
    from gripper_force.errors import SimulationError as SimulationError
    from gripper_force.errors import UnfamiliarFrameError as UnfamiliarFrameError
    from gripper_force.interfaces import BusStats as BusStats
    from gripper_force.interfaces import Camera as Camera
    from gripper_force.interfaces import Clock as Clock
    from gripper_force.interfaces import LoadCell as LoadCell
    from gripper_force.interfaces import Lock as Lock
    from gripper_force.interfaces import Servo as Servo
    from gripper_force.interfaces import ServoSpec as ServoSpec
    from gripper_force.interfaces import SharedPort as SharedPort
    from gripper_force.jobs.evaluate import Evaluation as Evaluation
    from gripper_force.jobs.evaluate import evaluate as evaluate
    from gripper_force.jobs.replay import replay as replay
    from gripper_force.jobs.replay.comparison import Comparison as Comparison
    from gripper_force.jobs.replay.comparison import ReplayResult as ReplayResult
    from gripper_force.progress import Progress as Progress
    from gripper_force.progress import Prompt as Prompt
    from gripper_force.runtime.gripper import Gripper as Gripper
    from gripper_force.runtime.gripper import open_gripper as open_gripper
    from gripper_force.runtime.log_reader import LogReader as LogReader
    from gripper_force.runtime.process import own_process as own_process
    from gripper_force.runtime.state import GraspResult as GraspResult
    from gripper_force.runtime.state import GripperState as GripperState
    from gripper_force.types import AttentionMap as AttentionMap
    from gripper_force.types import EstimateSource as EstimateSource
    from gripper_force.types import Event as Event
    from gripper_force.types import ForceEstimate as ForceEstimate
    from gripper_force.types import Frame as Frame
    from gripper_force.types import FusedForce as FusedForce
    from gripper_force.types import GraspStatus as GraspStatus
    from gripper_force.types import LoadCellSample as LoadCellSample
    from gripper_force.types import Outcome as Outcome
    from gripper_force.types import Phase as Phase
    from gripper_force.types import Record as Record
    from gripper_force.types import Request as Request
    from gripper_force.types import RequestKind as RequestKind
    from gripper_force.types import ServoCommand as ServoCommand
    from gripper_force.types import ServoState as ServoState
    from gripper_force.types import VisualForce as VisualForce
    from gripper_force.vision.estimator import ForceEstimator as ForceEstimator

__version__ = "0.2.0.dev0"

_MODULES = {
    "gripper_calibration.procedures.calibrate_object": ("ObjectCalibration", "calibrate_object"),
    "gripper_calibration.procedures.teach": ("Taught", "teach"),
    "gripper_force.config": ("CameraConfig", "Config", "LoadCellConfig", "ServoConfig", "load_config"),
    "gripper_force.errors": (
        "CheckpointError",
        "ConfigError",
        "DataError",
        "DeviceError",
        "DeviceLostError",
        "DeviceNotFoundError",
        "DeviceTimeoutError",
        "GripperError",
        "HardwareFaultError",
        "LogError",
        "NonFiniteError",
        "RequestError",
        "SimulationError",
        "UnfamiliarFrameError",
    ),
    "gripper_force.interfaces": (
        "BusStats",
        "Camera",
        "Clock",
        "LoadCell",
        "Lock",
        "Servo",
        "ServoSpec",
        "SharedPort",
    ),
    "gripper_force.jobs.evaluate": ("Evaluation", "evaluate"),
    "gripper_force.jobs.replay": ("replay",),
    "gripper_force.jobs.replay.comparison": ("Comparison", "ReplayResult"),
    "gripper_force.progress": ("Progress", "Prompt"),
    "gripper_force.runtime.gripper": ("Gripper", "open_gripper"),
    "gripper_force.runtime.log_reader": ("LogReader",),
    "gripper_force.runtime.process": ("own_process",),
    "gripper_force.runtime.state": ("GraspResult", "GripperState"),
    "gripper_force.types": (
        "AttentionMap",
        "EstimateSource",
        "Event",
        "ForceEstimate",
        "Frame",
        "FusedForce",
        "GraspStatus",
        "LoadCellSample",
        "Outcome",
        "Phase",
        "Record",
        "Request",
        "RequestKind",
        "ServoCommand",
        "ServoState",
        "VisualForce",
    ),
    "gripper_force.vision.estimator": ("ForceEstimator",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = ["__version__", *sorted(_MODULE_OF)]


def __getattr__(name: str) -> object:
    """Imports a public name when it is first used (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        value: object = getattr(_import_module(_MODULE_OF[name]), name)
    except ModuleNotFoundError:
        from gripper_force.plugins import importing

        with importing(f"gripper_force.{name}"):
            raise
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
