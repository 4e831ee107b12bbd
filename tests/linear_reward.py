"""A reward model that is known by heart: linear in what is observed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch

from prefrl.types import Candidate, Floats, Response, Segment, State


class LinearReward:
    """Members (E, O) of weights over observations; a response is worth the member's first weight times its length."""

    def __init__(self, *members: Sequence[float], fitted: bool = True, memory: int = 1, leak: float = 0.0) -> None:
        self._weights, self._fitted, self._memory = np.array(members), fitted, memory
        self.leak = leak
        """How much a score hangs on the size of its batch: a planted fault."""

    @property
    def members(self) -> int:
        return len(self._weights)

    @property
    def fitted(self) -> bool:
        return self._fitted

    @property
    def memory(self) -> int:
        return self._memory

    def rewards(self, observations: Floats, actions: Floats, begins: np.ndarray | None = None) -> Floats:
        found: Floats = observations.astype(np.float64) @ self._weights.mean(0)
        return found

    def raw_member_scores(self, candidates: Sequence[Candidate]) -> Floats:
        rows = np.array([[self._one(c, w) for c in candidates] for w in self._weights])
        found: Floats = rows + self.leak * len(candidates) * np.arange(len(candidates))
        return found

    def member_scores(self, candidates: Sequence[Candidate]) -> Floats:
        return self.raw_member_scores(candidates)

    def score(self, candidates: Sequence[Candidate]) -> Floats:
        found: Floats = self.raw_member_scores(candidates).mean(0)
        return found

    def features(self, candidates: Sequence[Candidate]) -> Floats:
        raise NotImplementedError

    def stack(self, candidates: Sequence[Candidate]) -> Mapping[str, torch.Tensor]:
        raise NotImplementedError

    def scores(self, stacked: Mapping[str, torch.Tensor]) -> torch.Tensor:
        raise NotImplementedError

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return ()

    def to(self, device: torch.device) -> None: ...

    def settle(self, stacked: Mapping[str, torch.Tensor], loss: object) -> torch.Tensor:
        raise NotImplementedError

    def calibrate(self, temperature: float) -> None:
        raise NotImplementedError

    def state(self) -> State:
        return {}

    def load(self, state: State) -> None:
        raise NotImplementedError

    def _one(self, candidate: Candidate, weights: Floats) -> float:
        if isinstance(candidate, Response):
            return float(weights[0] * (len(candidate.tokens) or len(candidate.text)))
        assert isinstance(candidate, Segment)
        return float((candidate.observations.astype(np.float64) @ weights).sum())


def segment(
    rng: np.random.Generator, name: int, weights: Sequence[float] = (1.0, -1.0, 0.5), steps: int = 6
) -> Segment:
    """A segment of noise whose gold is linear in what is observed."""
    observations = rng.normal(size=(steps, 3)).astype(np.float32)
    actions = rng.normal(size=(steps, 2)).astype(np.float32)
    return Segment(observations, actions, episode=str(name), start=0, gold=observations @ np.array(weights))
