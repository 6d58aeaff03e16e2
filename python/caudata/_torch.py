"""Networks of PyTorch as a policy file has them."""

from __future__ import annotations

from typing import Any, List, Sequence

import torch
from torch import nn

_ACTIVATIONS = {nn.ELU: "elu", nn.SiLU: "swish", nn.Tanh: "tanh", nn.ReLU: "relu"}


def dense(modules: Sequence[nn.Module]) -> List[Any]:
    """Weight and bias of each linear layer."""
    layers = [module for module in modules if isinstance(module, nn.Linear)]
    with torch.no_grad():
        return [(layer.weight.cpu().numpy(), layer.bias.cpu().numpy()) for layer in layers]


def activation(modules: Sequence[nn.Module]) -> str:
    """Name of the one activation between linear layers."""
    between = {type(module) for module in modules if not isinstance(module, nn.Linear)}
    names = [_ACTIVATIONS.get(kind, kind.__name__) for kind in between] or ["elu"]
    if len(names) > 1:
        raise ValueError("a policy file has one activation between its layers, not %s" % ", ".join(sorted(names)))
    return names[0]
