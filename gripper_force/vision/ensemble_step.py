"""What an engine runs for each frame: one streaming step of a whole ensemble, as one function of tensors."""

from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor, nn

from gripper_force.vision.header import NetworkConfig
from gripper_force.vision.network import ForceNetwork, StreamState

FRAME: Final = "frame"
FORCE: Final = "force_n"
FEATURES: Final = "features"
ATTENTION: Final = "attention"


class EnsembleStep(nn.Module):
    """One step of all members: their states go in and come out, so that any engine can run it.

    Inputs are ``frame`` (1, 1, S, S) and `state_names`. Outputs are ``force_n`` (M,), ``features`` (F,) of
    all members side by side, ``attention`` (h, w) of the first SSAM member if there is one, and the next
    states.
    """

    def __init__(self, networks: Sequence[ForceNetwork]) -> None:
        super().__init__()
        self.members = nn.ModuleList(networks)
        self._configs = [network.config for network in networks]
        attentions = [config.attention for config in self._configs]
        self._looks = attentions.index("ssam") if "ssam" in attentions else None

    @property
    def outputs(self) -> list[str]:
        """Names of what `forward` returns, in order."""
        attention = [] if self._looks is None else [ATTENTION]
        return [FORCE, FEATURES, *attention, *(f"next_{name}" for name in state_names(self._configs))]

    def forward(self, frame: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Takes the next frame; see the class."""
        forces, features, gates = [], [], []
        states: list[Tensor] = []
        left = list(state)
        for config, member in zip(self._configs, self.members, strict=True):
            assert isinstance(member, ForceNetwork)
            # Without earlier frames there are no maps: engines know no tensors of size zero.
            maps = left.pop(0) if config.maps_kept else member.blank().maps
            seen, after = member.step(frame, StreamState(maps, left.pop(0), left.pop(0)))
            forces.append(seen.force_n)
            features.append(seen.features[0])
            gates.append(seen.gates)
            states += after if config.maps_kept else after[1:]
        looks = [] if self._looks is None else [_of(gates[self._looks])]
        return torch.cat(forces), torch.cat(features), *looks, *states

    def blank(self) -> list[Tensor]:
        """States that remember nothing, as `forward` takes them."""
        states: list[Tensor] = []
        for config, member in zip(self._configs, self.members, strict=True):
            assert isinstance(member, ForceNetwork)
            blank = member.blank()
            states += blank if config.maps_kept else blank[1:]
        return states


def state_names(members: Sequence[NetworkConfig]) -> list[str]:
    """Names of an ensemble's states, in the order that `EnsembleStep` takes them in."""
    names = []
    for i, config in enumerate(members):
        names += [f"maps_{i}"] if config.maps_kept else []
        names += [f"hidden_{i}", f"cell_{i}"]
    return names


def _of(gates: Tensor | None) -> Tensor:
    assert gates is not None
    return gates[0, 0]  # (h, w)
