"""What a policy is: the sizes and kinds of its layers, its memory and its output. `workers/policies` computes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Activation = Literal["tanh", "relu"]
Output = Literal["tanh", "linear", "argmax", "categorical", "gaussian"]
NOISY_OUTPUTS = ("tanh", "linear")
"""Outputs to which action noise can be added: those that are numbers and not random by themselves."""
DISCRETE_OUTPUTS = ("argmax", "categorical")
"""Outputs that choose one of the actions, which is then 1 while the others are 0."""


@dataclass(frozen=True)
class PolicySpec:
    """Network of a policy. Its parameters are one flat vector [D]: per dense layer weights [in, out], then biases."""

    widths: tuple[int, ...]
    """Widths of the layers, from the observation to the action, without the memory."""
    activation: Activation = "tanh"
    """Function after each hidden layer."""
    output: Output = "tanh"
    """What makes an action of the last layer; see `workers.policies.policy`."""
    bias: bool = True
    """Whether the layers have biases."""
    memory: int = 0
    """Units of the gated recurrent cell between the hidden layers and the last one; 0: there is none."""

    @property
    def outputs(self) -> int:
        """Outputs of the last layer: one for each action, and for `gaussian` another one for its spread."""
        return self.widths[-1] * (2 if self.output == "gaussian" else 1)

    @property
    def layers(self) -> tuple[tuple[int, int], ...]:
        """(inputs, outputs) of each dense layer in the order of the parameters.

        A recurrent cell has two, whose inputs are those of the cell followed by the memory: its two gates, and then the
        candidate for the next memory. The layer after the cell has the memory as its input.
        """
        layers, last = list(zip(self.widths[:-2], self.widths[1:-1], strict=True)), self.widths[-2]
        if self.memory:
            layers += [(last + self.memory, 2 * self.memory), (last + self.memory, self.memory)]
            last = self.memory
        return (*layers, (last, self.outputs))

    @property
    def parameters(self) -> int:
        """Number of parameters, D."""
        return sum((inputs + self.bias) * outputs for inputs, outputs in self.layers)
