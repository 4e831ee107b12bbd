"""Direct preference optimisation for text: the policy is fitted on the judgements, without the reward model.

Variant: the sigmoid loss (Rafailov et al. 2023, equation 7) or IPO's square (Azar et al. 2024, equation 17) on all
pairs that the judgements imply, the starting policy as the reference. Soft preferences, ties and label smoothing are
soft targets (cDPO, Mitchell 2023); the pairs of one ranking share its weight. Left out: a supervised term, refreshing
the reference.
"""

from __future__ import annotations

from functools import partial
from typing import Literal

import numpy as np
from pydantic import Field

from prefrl.improve.direct import Direct, PairLossSettings, Pairs, pair_formula, step
from prefrl.improve.pairs import judged, means
from prefrl.improve.writer import Writer
from prefrl.protocols import RewardModel, Store, Task, text
from prefrl.types import Metrics, Response


class DPOSettings(PairLossSettings):
    """Direct preference optimisation on all judgements so far, held near the starting policy."""

    kind: Literal["dpo"] = "dpo"
    epochs: int = Field(1, ge=1)
    """Passes over all pairs in a round."""
    minibatch: int = Field(16, ge=1)
    """Pairs in a gradient step."""

    def shrunk(self) -> DPOSettings:
        return self.model_copy(update={"epochs": 1, "evaluation_prompts": 8})

    def build(self, task: Task, rng: np.random.Generator) -> Direct:
        return Direct(self, text(task, f"learner kind {self.kind!r} writes text"), partial(improve, self), rng)

    def formula(self) -> str:
        return pair_formula(self)


def improve(
    settings: DPOSettings,
    writer: Writer,
    reward: RewardModel[Response],
    store: Store[Response],
    rng: np.random.Generator,
) -> Metrics:
    """Passes over all judged pairs. Metrics: means over steps of those of `prefrl.improve.direct.step`, and pairs.

    Raises ValueError without a judged pair.
    """
    pairs = Pairs.of(judged(store, settings.kind), writer.policy, settings.length_normalised)
    minibatches = pairs.minibatches(settings.epochs, settings.minibatch, rng)
    steps = [step(writer, settings, pairs, at, settings.pair_loss) for at in writer.paced(minibatches)]
    return means(steps) | {"pairs": float(len(pairs))}
