"""Weighted sums of loss terms, for all methods."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from torch import Tensor

from devrf.errors import DevrfError, expect


def counted_weights(
    weights: Mapping[str, float], terms: Collection[str], key: str
) -> dict[str, float]:
    """The weights that are not zero.

    Args:
        weights: by the term's name.
        terms: the names of all terms.
        key: the config key of the weights, for messages.

    Raises:
        DevrfError: there is no such term, a weight is negative, or none counts.
    """
    counted = {name: weight for name, weight in weights.items() if weight}
    for name in sorted(map(str, counted)):
        if name not in terms:
            raise DevrfError(
                f"{key}: unknown term {name!r}; the terms are {', '.join(sorted(terms))}"
            )
        expect(counted[name] > 0, f"{key}.{name}", "at least 0", counted[name])
    if not counted:
        raise DevrfError(f"{key}: every weight is zero; at least one term must count")
    return counted


def weighted_sum(
    values: Mapping[str, Tensor], weights: Mapping[str, float]
) -> tuple[Tensor, dict[str, Tensor]]:
    """Σ weight · value () over ``values`` () by name; and these, detached."""
    if not values:
        raise DevrfError("loss: no term counts here; give one of its weights a value above 0")
    total = next(iter(values.values())).new_zeros(())
    for name, value in values.items():
        total = torch.add(total, value, alpha=weights[name])
    return total, {name: value.detach() for name, value in values.items()}


@torch.no_grad()
def visibility(transmittance: Tensor, alpha: Tensor | None) -> dict[str, Tensor]:
    """The mean opacity () of rays in [0, 1], and that of their alpha masks.

    Args:
        transmittance: (R,) T_end.
        alpha: (R,) A of the images' alpha masks; None: they have none.
    """
    hit = {"opacity": 1 - transmittance.mean()}
    return hit if alpha is None else {**hit, "coverage": alpha.mean()}
