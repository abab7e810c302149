"""Public Dynamixel clients work with the virtual servo as with a real one.

They are not dependencies of this project and run in a separate environment.
"""

import json
import os
import subprocess
import sys

import pytest

from gripper_hw.dynamixel.pty_server import serve_virtual_servo

PYTHON_VARIABLE = "GRIPPER_FORCE_CLIENT_PYTHON"
SKIP_REASON = (
    f"{PYTHON_VARIABLE} does not name a Python that has {{client}}; run python3 -m venv /tmp/clients && "
    "/tmp/clients/bin/pip install rustypot dynamixel-python; "
    f"then {PYTHON_VARIABLE}=/tmp/clients/bin/python pytest {__file__}"
)

# Each script finds servos 1 and 2, reads their positions, turns torque on, is refused another operating mode,
# and moves both to a goal. The XL330 is the model that all three clients support.
ROBOTIS = """
from dynamixel_sdk import *
from dynamixel_sdk import port_handler
port_handler.LATENCY_TIMER = 1000  # a busy machine is slower than any adapter
port, packets = PortHandler(path), PacketHandler(2.0)
port.openPort()
port.setBaudRate(1_000_000)
found, _ = packets.broadcastPing(port)
reader, bulk = GroupSyncRead(port, packets, 132, 4), GroupBulkRead(port, packets)
writer = GroupSyncWrite(port, packets, 116, 4)
for id_ in (1, 2):
    reader.addParam(id_)
    bulk.addParam(id_, 146, 1)
    writer.addParam(id_, (2300).to_bytes(4, "little"))
def positions():
    assert reader.txRxPacket() == COMM_SUCCESS
    return [reader.getData(id_, 132, 4) for id_ in (1, 2)]
before = positions()
assert bulk.txRxPacket() == COMM_SUCCESS
celsius = [bulk.getData(id_, 146, 1) for id_ in (1, 2)]
for id_ in (1, 2):
    assert packets.write1ByteTxRx(port, id_, 64, 1) == (COMM_SUCCESS, 0)
_, refusal = packets.write1ByteTxRx(port, 1, 11, 5)
writer.txPacket()
models = {id_: number for id_, (number, firmware) in found.items()}
"""
RUSTYPOT = """
from rustypot import Xl330PyController
bus = Xl330PyController(path, 1_000_000, 1.0)
models = bus.broadcast_scan()
positions = lambda: bus.sync_read_raw_present_position([1, 2])
before = positions()
celsius = bus.sync_read_present_temperature([1, 2])
for register in bus.registers():
    # Its table is of another firmware, with an acceleration limit and with indirect data from 224 on.
    if register.addr not in (40, 228, 229):
        assert bus.read_register_with_error(1, register.name)[1] == 0, register.name
bus.sync_write_torque_enable([1, 2], [True, True])
refusal = bus.write_register_with_error(1, "operating_mode", 5)
bus.sync_write_raw_goal_position([1, 2], [2300, 2300])
bus.set_fast_sync_read(True)
"""
DYNAMIXEL_PYTHON = """
from dxl2.v2 import BulkParams, MotorBus, SyncParams
bus = MotorBus(path, timeout=1.0)
bus.connect()
models = {id_: found["model_number"] for id_, found in bus.broadcast_ping().data.items()}
wanted, bulk, torque, goals = SyncParams(132, 4), BulkParams(), SyncParams(64, 1), SyncParams(116, 4)
for id_ in (1, 2):
    wanted.add_motor(id_)
    bulk.add_address(id_, 146, 1)
    torque.add_value(id_, 1)
    goals.add_value(id_, 2300)
positions = lambda: bus.fast_sync_read(wanted).data
before = bus.sync_read(wanted).data
celsius = bus.fast_bulk_read(bulk).data
bus.sync_write(torque)
refusal = bus.write(1, 11, 1, 5).error
bus.sync_write(goals)
"""
REPORT = """
for _ in range(100_000):
    if min(positions()) > 2200:
        break
json.dump({"models": models, "before": before, "celsius": celsius, "refusal": refusal,
           "arrived": min(positions()) > 2200}, sys.stdout)
"""


@pytest.mark.parametrize(
    ("client", "script"),
    [
        pytest.param("dynamixel_sdk", ROBOTIS, id="robotis"),
        pytest.param("rustypot", RUSTYPOT, id="rustypot"),
        pytest.param("dxl2", DYNAMIXEL_PYTHON, id="dynamixel-python"),
    ],
)
def test_public_client_works_with_the_virtual_servo(client: str, script: str) -> None:
    python = sys.executable if client == "dynamixel_sdk" else os.environ.get(PYTHON_VARIABLE, "")
    if not python or subprocess.run([python, "-c", f"import {client}"], capture_output=True).returncode:
        pytest.skip(SKIP_REASON.format(client=client))
    with serve_virtual_servo("XL330-M288", ids=(1, 2)) as server:
        code = f"import json, sys\npath = {server.device_path!r}{script}{REPORT}"
        run = subprocess.run([python, "-c", code], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout) == {
        "models": {"1": 1200, "2": 1200},
        "before": [2048, 2048],
        "celsius": [30, 30],
        "refusal": 7,  # access error: torque is on
        "arrived": True,
    }
