"""Learners from recorded segments: CPL and IQL, and the cloning that both begin with."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
import torch
from control_stubs import Known, point
from torch import Tensor

from prefrl.envs.control import GymnasiumTask
from prefrl.improve.cpl import CPLSettings
from prefrl.improve.iql import IQLSettings
from prefrl.improve.objectives import cpl_loss, expectile_loss
from prefrl.improve.offline import Offline
from prefrl.judgements import Comparison, Judged, Ranking
from prefrl.protocols import Store
from prefrl.types import Query, Segment

SMALL: dict[str, Any] = {"hidden": (16,), "learning_rate": 1e-2, "evaluation_episodes": 4, "cloning_minibatch": 64}
KINDS: dict[str, Any] = {
    "cpl": CPLSettings(**SMALL, cloning_epochs=2, epochs=20, minibatch=16, alpha=1.0),
    "iql": IQLSettings(**SMALL, discount=0.8, temperature=20.0, critic_steps=300, policy_steps=300, minibatch=64),
}


class Answers:
    """A store of judged pairs of segments."""

    def __init__(self, judged: list[Judged[Segment]]) -> None:
        self._judged = judged

    def judged(self, upto: int | None = None) -> list[Judged[Segment]]:
        return self._judged

    def demonstrations(self) -> list[Any]:
        return []


def recorded(count: int, seed: int = 0, discrete: bool = False, steps: int = 5) -> list[Segment]:
    """Random pushes of the point, of which the gold knows how good they are."""
    rng, found = np.random.default_rng(seed), []
    for i in range(count):
        x, rows = rng.uniform(-1, 1), []
        for _ in range(steps):
            push = float(rng.choice((-1.0, 1.0)) if discrete else rng.uniform(-1, 1))
            action = [float(push < 0), float(push > 0)] if discrete else [push]
            rows.append((x, action))
            x = float(np.clip(x + 0.2 * push, -2, 2))
        observations = np.array([[at] for at, _ in rows], np.float32)
        actions = np.array([action for _, action in rows], np.float32)
        found.append(Segment(observations, actions, f"e{i}", 0, gold=np.full(steps, np.nan)))
    return found


def towards(one: Segment) -> float:
    """How much its pushes went to the middle: what CPL takes people to judge."""
    push = one.actions[:, 0] if one.actions.shape[1] == 1 else one.actions @ np.array([-1.0, 1.0])
    return float(-(np.sign(one.observations[:, 0]) * push).sum())


def pairs(count: int = 200, discrete: bool = False) -> Store[Segment]:
    some = recorded(2 * count, discrete=discrete)
    judged = []
    for a, b in zip(some[::2], some[1::2], strict=True):
        query = Query((a, b))
        lead = towards(query.candidates[0]) - towards(query.candidates[1])
        judged.append(Judged(query, Comparison(query.id, 0.5 + 0.5 * float(np.sign(lead)))))
    return cast("Store[Segment]", Answers(judged))


def learner(kind: str, task: GymnasiumTask | None = None, **changes: object) -> Offline:
    settings = KINDS[kind].model_copy(update=changes)
    made: Offline = settings.build(task or point(), np.random.default_rng(0))
    return made


def flat(one: Offline) -> Tensor:
    return torch.cat([p.detach().flatten() for p in one.policy.parameters()])


# --- losses -------------------------------------------------------------------------------------------------------


def test_the_loss_of_cpl_on_numbers_worked_out_by_hand() -> None:
    first, second = torch.tensor([2.0, 1.0]), torch.tensor([1.0, -1.0])
    sure = -torch.log(torch.sigmoid(torch.tensor([2 - 0.5 * 1.0, 1 + 0.5 * 1.0])))
    other = -torch.log(torch.sigmoid(torch.tensor([1 - 0.5 * 2.0, -1 - 0.5 * 1.0])))
    torch.testing.assert_close(cpl_loss(first, second, torch.ones(2), 0.5), sure)
    torch.testing.assert_close(cpl_loss(second, first, torch.zeros(2), 0.5), sure)
    torch.testing.assert_close(cpl_loss(first, second, torch.full((2,), 0.25), 0.5), 0.25 * sure + 0.75 * other)


def test_without_a_bias_the_optimum_of_cpl_is_the_policy_that_explains_the_judgements() -> None:
    """One state, three actions, segments of one step: log pi x alpha gives back the log-odds of the answers."""
    alpha, best = 0.5, torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    first, second = torch.tensor([[0, 1], [0, 2], [1, 2]]).T
    answers = torch.sigmoid(alpha * (best[first].log() - best[second].log()))
    logits = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([logits], max_iter=200, tolerance_grad=1e-12)

    def closure() -> Tensor:
        optimizer.zero_grad()
        scores = alpha * logits.log_softmax(0)
        loss = cpl_loss(scores[first], scores[second], answers, 1.0).mean()
        loss.backward()  # type: ignore[no-untyped-call]
        return loss

    optimizer.step(closure)  # type: ignore[no-untyped-call]
    torch.testing.assert_close(logits.detach().softmax(0), best, atol=1e-5, rtol=1e-5)


def test_the_gradient_of_a_step_is_that_of_finite_differences() -> None:
    """Of CPL's loss by the policy's weights, by hand and by torch, with a discount and segments of other lengths."""
    one = learner("cpl", discount=0.8)
    segments = [*recorded(2, 1), *recorded(2, 2, steps=3)]
    one.policy.observe(np.concatenate([s.observations for s in segments]))
    from prefrl.improve.offline import Recordings

    recordings = Recordings.of(segments, one.policy)
    rows, whose, before = recordings.steps(np.array([2, 0, 1, 3]))
    assert whose.tolist() == [0] * 3 + [1] * 5 + [2] * 5 + [3] * 3
    assert before.tolist() == [0, 1, 2, 0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1, 2]
    some = recordings.decisions.rows(torch.from_numpy(rows))

    def loss_of(logp: Tensor) -> Tensor:
        scores = one.scores(logp, whose, before).view(-1, 2)
        return cpl_loss(scores[:, 0], scores[:, 1], torch.tensor([1.0, 0.3]), 0.5).sum()

    loss = loss_of(one.policy.log_prob(some)[0])
    (slope,) = torch.autograd.grad(loss, list(one.policy.parameters()))
    parameter = next(iter(one.policy.parameters()))
    for i in (0, 5, 20):
        values = []
        for by in (1e-2, -1e-2):
            with torch.no_grad():
                parameter[i] += by
                values.append(float(loss_of(one.policy.log_prob(some)[0])))
                parameter[i] -= by
        assert (values[0] - values[1]) / 2e-2 == pytest.approx(float(slope[i]), rel=2e-2, abs=2e-3)
    found = one.descend(recordings.decisions, rows, lambda logp: (loss_of(logp), {}))
    assert found["loss"] == pytest.approx(float(loss.detach()), rel=1e-5)
    assert found["grad_norm"] == pytest.approx(float(slope.norm()), rel=1e-4)


def test_an_expectile_weighs_what_lies_above_more() -> None:
    torch.testing.assert_close(expectile_loss(torch.tensor([2.0, -2.0]), 0.7), torch.tensor([0.7 * 4, 0.3 * 4]))


# --- learners -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("discrete", [False, True], ids=["box", "discrete"])
@pytest.mark.parametrize("kind", KINDS)
def test_from_random_behaviour_it_learns_what_was_preferred(kind: str, discrete: bool) -> None:
    """The rewards and the judgements say: to the middle. A clone does nothing of the kind."""
    reward, spent = Known(), list[int]()
    one = learner(kind, point(discrete, spent))
    metrics = one.improve(reward, pairs(discrete=discrete), np.random.default_rng(1))
    assert not spent  # no step was taken to learn
    assert all(np.isfinite(value) for value in metrics.values())
    found = one.evaluate(reward, np.random.default_rng(0)).metrics
    clone = learner("cpl", point(discrete), epochs=0)
    clone.improve(reward, pairs(discrete=discrete), np.random.default_rng(1))
    plain = clone.evaluate(reward, np.random.default_rng(0)).metrics
    assert found["gold"] > plain["gold"] + 1
    assert one.steps.learn == 0
    if kind == "cpl":
        assert found["agreement"] > max(0.6, plain["agreement"])
        assert found["judgement_loss"] < 0.55


@pytest.mark.parametrize("kind", KINDS)
def test_it_never_looks_at_the_gold_and_a_resumed_one_goes_on_alike(kind: str) -> None:
    changes = {"epochs": 2} if kind == "cpl" else {"critic_steps": 5, "policy_steps": 5}
    store = pairs(40)
    shown = [
        Judged(Query(tuple(replace(c, gold=np.ones(5)) for c in j.query.candidates)), j.judgement)
        for j in store.judged()
    ]
    whole, seeing, first, second = (learner(kind, point(hide_gold=i != 1), **changes) for i in range(4))
    for seed in (1, 2):
        whole.improve(Known(), store, np.random.default_rng(seed))
        seeing.improve(Known(), cast("Store[Segment]", Answers(shown)), np.random.default_rng(seed))
    assert torch.equal(flat(whole), flat(seeing))
    assert np.isnan(whole.evaluate(Known(), np.random.default_rng(0)).metrics["gold"])
    first.improve(Known(), store, np.random.default_rng(1))
    second.load(first.state())
    second.improve(Known(), store, np.random.default_rng(2))
    assert torch.equal(flat(whole), flat(second))
    assert not torch.equal(flat(whole), flat(first))


def test_the_pairs_of_a_ranking_share_its_weight() -> None:
    some = recorded(3)
    query = Query(tuple(some))
    store = Answers([Judged(query, Ranking(query.id, (0, 1, 2)))])
    one = learner("cpl", epochs=1)
    assert one.improve(Known(), cast("Store[Segment]", store), np.random.default_rng(0))["pairs"] == 3


def test_nothing_to_learn_from_is_said() -> None:
    nothing = cast("Store[Segment]", Answers([]))
    for kind in KINDS:
        with pytest.raises(ValueError, match=f"{kind} learns from segments: set learner.data"):
            learner(kind).improve(Known(), nothing, np.random.default_rng(0))
