"""Labels that a reward model finds improbable: left out, or turned round.

Variant: the denoising discriminator of RIME (Cheng et al. 2024, section 4.2), asked once an epoch. Its spread is that
of all losses of the epoch, where the authors' code keeps a running variance of the trusted ones. Judgements of every
kind are filtered, but only pairs are turned round. Left out: the warm start of the reward model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from prefrl.fit.terms import Terms

SHARE = 0.5
"""Their alpha."""
SPREAD, LEAST_SPREAD, DECAY = 3.0, 1.0, 30
"""Their beta: from 3 down to 1, over so many epochs."""
MOST_SPREAD = 3.0
TURNED = -math.log(0.001)
"""A label is turned round where the model gives it less than one chance in a thousand."""
KEEP = 0.9
"""How much of the old ceiling a new epoch keeps."""


class Verdict(NamedTuple):
    """What becomes of judgements."""

    keep: Tensor
    """(J,) bool: used for fitting."""
    flip: Tensor
    """(J,) bool: used the other way round."""


@dataclass(frozen=True)
class Discriminator:
    """The denoising discriminator of RIME, section 4.2, as it stands after some epochs."""

    epochs: int = 0
    ceiling: float = math.log(2)
    """Running maximum of a trusted judgement's loss. A model that knows nothing has log 2, and trusts all pairs."""

    def judge(self, loss: Tensor, pairs: Tensor) -> tuple[Verdict, Discriminator]:
        """Losses (J,) of judgements, log 2 where nothing is known -> who is trusted, and what comes next.

        A judgement is trusted below -log(x) + x / 2 + beta s, where x is the `ceiling` and s the losses' standard
        deviation. One of a pair (`pairs` (J,) bool) that is less probable than 1 in 1000 is turned round.
        """
        spread = max(LEAST_SPREAD, SPREAD - (SPREAD - LEAST_SPREAD) * self.epochs / DECAY)
        deviation = float(loss.std(correction=0)) if len(loss) else 0.0
        # The spread term is capped: with a few absurd losses the deviation alone would let everything through.
        bound = -math.log(self.ceiling + 1e-8) + SHARE * self.ceiling + min(spread * deviation, MOST_SPREAD)
        trusted, flip = loss < bound, (loss > TURNED) & pairs
        ceiling = self.ceiling
        if trusted.any():
            ceiling = KEEP * ceiling + (1 - KEEP) * float(loss[trusted].max())
        # What is turned round is used as well.
        return Verdict(trusted | flip, flip), Discriminator(self.epochs + 1, ceiling)


def flipped(terms: Terms, flip: Tensor) -> Terms:
    """The terms with the pairs of some judgements (J,) turned round."""
    choices = terms.choices
    # (S, K): the two of a pair stand first, the rest fills the row.
    turned = torch.cat([choices.target[:, :2].flip(1), choices.target[:, 2:]], 1)
    target = torch.where(flip[choices.judgement][:, None], turned, choices.target)
    return replace(terms, choices=replace(choices, target=target))
