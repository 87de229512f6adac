"""How much the order of splats matters: pictures in the order of centres against those in the order along rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from .reference import finite_decibels

VISIBLE = 1 / 255  # a smaller difference of colours is not seen in a picture of 8 bits


@dataclass(frozen=True)
class OrderDifference:
    """How far pictures in two orders are apart.

    Attributes:
        psnr: dB, over all pixels and channels.
        share: Of the pixels, in which a channel differs by more than VISIBLE.
        rms: Root mean square over the pixels and channels of the picture that differs most, in units of colour.
    """

    psnr: float
    share: float
    rms: float

    @classmethod
    def of(cls, pairs: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> OrderDifference:
        """Of at least one pair of pictures (3, H, W) of floats in both orders, of any sizes. Waits for the device."""
        differences = [(one.double() - other).abs() for one, other in pairs]
        mean = sum(d.square().sum().item() for d in differences) / sum(d.numel() for d in differences)
        seen = sum((d.amax(0) > VISIBLE).sum().item() for d in differences)
        return cls(
            psnr=finite_decibels(mean),
            share=seen / sum(d[0].numel() for d in differences),
            rms=max(d.square().mean().sqrt().item() for d in differences),
        )
