"""Protocols of callbacks with which long work reports to a person."""

from typing import Protocol


class Progress(Protocol):
    """Callback that long work calls to report what it does."""

    def __call__(self, text: str, steps: int = 1) -> None:
        """Reports progress.

        Args:
            text: What is being done, for a person.
            steps: Steps of the announced total that were finished since the last call; 0 for none.
        """


class Prompt(Protocol):
    """Callback that asks a person to do something."""

    def __call__(self, text: str) -> None:
        """Shows an instruction and returns once the person has confirmed it."""


def no_progress(text: str, steps: int = 1) -> None:
    """Ignores progress reports."""
