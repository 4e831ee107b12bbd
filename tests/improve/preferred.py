"""What the tests of direct methods prefer: a word on the toy, and on the tiny model a reward whose optimum is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import torch
from test_fixed_points import ALL, logp
from torch import Tensor

from prefrl.envs.text import Reviews
from prefrl.improve.direct import Direct
from prefrl.improve.dpo import DPOSettings
from prefrl.judgements import Comparison, Demonstrated, Judged
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, Store, Task
from prefrl.types import Floats, Metrics, Query, Response

SMALL: dict[str, Any] = {"evaluation_prompts": 64, "learning_rate": 5e-3, "policy": {"chunk": 6}}
NO_STORE = cast("Store[Response]", None)
NO_REWARD = cast("RewardModel[Response]", None)


class Likes:
    """Scores a response by how often it says "the"."""

    def score(self, candidates: Sequence[Response]) -> Floats:
        return np.array([r.text.split().count("the") for r in candidates], np.float32)


LIKES = cast("RewardModel[Response]", Likes())


class Answers:
    """A store of pairs that are judged by a function of both scores."""

    def __init__(
        self, candidates: Sequence[Response], reward: RewardModel[Response], answer: Callable[[float], float]
    ) -> None:
        pairs = [Query((a, b)) for a, b in zip(candidates[::2], candidates[1::2], strict=True) if a.id != b.id]
        leads = [float(-np.diff(reward.score(query.candidates))[0]) for query in pairs]
        self._judged = [Judged(q, Comparison(q.id, answer(lead))) for q, lead in zip(pairs, leads, strict=True)]

    def demonstrations(self, upto: int | None = None) -> list[Demonstrated[Response]]:
        return []

    def judged(self) -> list[Judged[Response]]:
        return self._judged


def sure(lead: float) -> float:
    """The one with the higher score, or a tie."""
    return 0.5 + 0.5 * float(np.sign(lead))


def answers(
    candidates: Sequence[Response],
    reward: RewardModel[Response] = LIKES,
    answer: Callable[[float], float] = sure,
) -> Store[Response]:
    return cast("Store[Response]", Answers(candidates, reward, answer))


class Implied:
    """The reward that one model is the optimum of, held near another: beta x the log-ratio of the two."""

    def __init__(self, best: Any, start: Any, beta: float) -> None:
        with torch.no_grad():
            found = (beta * (logp(best) - logp(start))).tolist()
        rows = zip(ALL.tokens.tolist(), ALL.mask.sum(1).tolist(), found, strict=True)
        self._of = {tuple(tokens[:length]): worth for tokens, length, worth in rows}

    def score(self, candidates: Sequence[Response]) -> Floats:
        return np.array([self._of[c.tokens] for c in candidates], np.float32)


def implied(best: Any, start: Any, beta: float) -> RewardModel[Response]:
    return cast("RewardModel[Response]", Implied(best, start, beta))


def at(best: Any, settings: Any, task: Task) -> Direct:
    """A learner whose policy is the tiny model's optimum already."""
    one: Direct = settings.build(task, np.random.default_rng(0))
    one.policy.load({name: p.detach().clone() for name, p in best.named_parameters()})
    return one


def flat(one: Direct) -> Tensor:
    return torch.cat([p.flatten() for p in one.state()["model"].values()])


def toy_answers(task: Reviews, count: int = 160) -> Store[Response]:
    """Pairs of the starting policy's responses, of which the one that says the word more often is better."""
    return answers(DPOSettings().build(task, np.random.default_rng(0)).sample(count, np.random.default_rng(0)))


def check_resumed(settings: Any, task: Reviews, reward: RewardModel[Response], store: Store[Response]) -> None:
    """The same seed gives the same bytes, and a resumed learner goes on alike."""
    whole, first, second = (settings.build(task, np.random.default_rng(0)) for _ in range(3))
    for seed in (1, 2):
        whole.improve(reward, store, np.random.default_rng(seed))
    first.improve(reward, store, np.random.default_rng(1))
    second.load(first.state())
    second.improve(reward, store, np.random.default_rng(2))
    assert torch.equal(flat(whole), flat(second))
    assert not torch.equal(flat(whole), flat(first))


def with_chunks(
    settings: Any, task: Reviews, reward: RewardModel[Response], store: Store[Response]
) -> tuple[Metrics, Metrics]:
    """What one round measures with parts of two rows, and with one of all."""
    found = []
    for chunk in (2, 1000):
        sized = settings.model_copy(update={"policy": settings.policy.model_copy(update={"chunk": chunk})})
        one = sized.build(task, np.random.default_rng(0))
        found.append(one.improve(reward, store, np.random.default_rng(1)))
    return found[0], found[1]


def in_this_order(candidates: Sequence[Response]) -> RewardModel[Response]:
    """A reward for which the first is the best, and the last the worst."""
    ids = [c.id for c in candidates]

    class Order:
        def score(self, some: Sequence[Response]) -> Floats:
            return np.array([-ids.index(c.id) for c in some], np.float32)

    return cast("RewardModel[Response]", Order())


def gains(one: Direct, candidates: Sequence[Response]) -> list[float]:
    """The log-ratio of each to the starting policy, one by one."""
    found = []
    for each in candidates:
        row = Responses.of([each], one.policy.task)
        with torch.no_grad():
            found.append(float((one.policy.log_prob(row)[0] - one.policy.start_logp(row)).sum()))
    return found
