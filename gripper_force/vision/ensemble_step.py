"""One streaming step of an ensemble as one function of tensors, which every engine can run."""

from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor, nn

from gripper_force.vision.checkpoint import Member
from gripper_force.vision.gaussian_process import GaussianProcess
from gripper_force.vision.header import GaussianProcessConfig, NetworkConfig
from gripper_force.vision.network import ForceNetwork, StreamState

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
        forces: list[Tensor] = []
        features: list[Tensor] = []
        gates: list[Tensor | None] = []
        next_states: list[Tensor] = []
        inputs = list(state)
        for member in self.members:
            if isinstance(member, GaussianProcess):
                output = member.step(frame)
                forces.append(output.force_n)
                features.append(output.features[0])
                gates.append(None)
                continue
            assert isinstance(member, ForceNetwork)
            config = member.config
            # Without earlier frames there is no maps input: engines do not take tensors of size zero.
            maps = inputs.pop(0) if config.maps_kept else member.zero_state().maps
            output, state_after = member.step(frame, StreamState(maps, inputs.pop(0), inputs.pop(0)))
            forces.append(output.force_n)
            features.append(output.features[0])
            gates.append(output.gates)
            next_states += state_after if config.maps_kept else state_after[1:]
        attention = [] if self._ssam_member is None else [_map(gates[self._ssam_member])]
        return torch.cat(forces), torch.cat(features), *attention, *next_states

    def zero_states(self) -> list[Tensor]:
        """Returns states of zeros, in the order in which `forward` takes them."""
        states: list[Tensor] = []
        for member in self.members:
            if isinstance(member, GaussianProcess):
                continue
            assert isinstance(member, ForceNetwork)
            state = member.zero_state()
            states += state if member.config.maps_kept else state[1:]
        return states


def state_names(members: Sequence[NetworkConfig | GaussianProcessConfig]) -> list[str]:
    """Returns the names of an ensemble's states, in the order in which `EnsembleStep` takes them."""
    names = []
    for i, config in enumerate(members):
        if isinstance(config, GaussianProcessConfig):
            continue
        names += [f"maps_{i}"] if config.maps_kept else []
        names += [f"hidden_{i}", f"cell_{i}"]
    return names


def _map(gates: Tensor | None) -> Tensor:
    assert gates is not None
    return gates[0, 0]  # (h, w)
