"""One streaming step of an ensemble as one function of tensors, which every engine can run."""

from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor, nn

from gripper_force.vision.checkpoint import Member
from gripper_force.vision.gaussian_process import GaussianProcess
from gripper_force.vision.header import GaussianProcessConfig, NetworkConfig
from gripper_force.vision.network import ForceNetwork, Output, StreamState

FRAME: Final = "frame"
FORCE: Final = "force_n"
FEATURES: Final = "features"
ATTENTION: Final = "attention"


class EnsembleStep(nn.Module):
    """One step of all members. The states are inputs and outputs.

    Inputs are ``frame`` (1, 1, S, S) and `state_names`. Outputs are ``force_n`` (M,), the members'
    concatenated ``features`` (F,), ``attention`` (h, w) of the first SSAM member if one exists, and the next
    states.
    """

    def __init__(self, networks: Sequence[Member]) -> None:
        super().__init__()
        self.members = nn.ModuleList(networks)
        self._configs = [network.config for network in networks]
        attentions = [config.attention for config in self._configs]
        self._ssam_member = attentions.index("ssam") if "ssam" in attentions else None

    @property
    def outputs(self) -> list[str]:
        """Names of the outputs of `forward`, in order."""
        attention = [] if self._ssam_member is None else [ATTENTION]
        return [FORCE, FEATURES, *attention, *(f"next_{name}" for name in state_names(self._configs))]

    def forward(self, frame: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Runs all members on the next frame; shapes as in the class."""
        outputs: list[Output] = []
        next_states: list[Tensor] = []
        inputs = list(state)
        for member in self.members:
            if isinstance(member, GaussianProcess):
                outputs.append(member.step(frame))
                continue
            assert isinstance(member, ForceNetwork)
            first_state = _first_state(member.config)
            maps = member.zero_state().maps if first_state else inputs.pop(0)
            output, state_after = member.step(frame, StreamState(maps, inputs.pop(0), inputs.pop(0)))
            outputs.append(output)
            next_states += state_after[first_state:]
        attention = [] if self._ssam_member is None else [_map(outputs[self._ssam_member].gates)]
        forces_n = torch.cat([output.force_n for output in outputs])
        features = torch.cat([output.features[0] for output in outputs])
        return forces_n, features, *attention, *next_states

    def zero_states(self) -> list[Tensor]:
        """Returns states of zeros, in the order in which `forward` takes them."""
        networks = [member for member in self.members if isinstance(member, ForceNetwork)]
        return [state for net in networks for state in net.zero_state()[_first_state(net.config) :]]


def state_names(members: Sequence[NetworkConfig | GaussianProcessConfig]) -> list[str]:
    """Returns the names of an ensemble's states, in the order in which `EnsembleStep` takes them."""
    networks = [(i, config) for i, config in enumerate(members) if isinstance(config, NetworkConfig)]
    return [f"{name}_{i}" for i, config in networks for name in StreamState._fields[_first_state(config) :]]


def _first_state(config: NetworkConfig) -> int:
    """Index of the first part of a network's `StreamState` that is an input.

    Without earlier frames there are no maps: engines do not take tensors of size zero.
    """
    return 0 if config.maps_kept else 1


def _map(gates: Tensor | None) -> Tensor:
    assert gates is not None
    return gates[0, 0]  # (h, w)
