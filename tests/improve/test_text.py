from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.envs.text import Reviews
from prefrl.improve.groups import advantages_of
from prefrl.improve.text import TextLearner, TextLearnerSettings, text_formula
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, Store
from prefrl.types import Floats, Response, State, Steps

NO_STORE = cast("Store[Response]", None)
SMALL: dict[str, Any] = {"updates": 2, "prompts": 4, "responses": 4, "evaluation_prompts": 16, "policy": {"chunk": 7}}


@dataclass
class Rewarded:
    """A reward that likes one token, or any other function of a response."""

    token: int = 5
    constant: float | None = None
    seen: tuple[Response, ...] = ()

    def score(self, candidates: Sequence[Response]) -> Floats:
        self.seen = tuple(candidates)
        if self.constant is not None:
            return np.full(len(candidates), self.constant, np.float32)
        return np.array([r.tokens.count(self.token) for r in candidates], np.float32)


def reward(token: int = 5, constant: float | None = None) -> RewardModel[Response]:
    return cast("RewardModel[Response]", Rewarded(token, constant))


def learner(task: Reviews, **changes: object) -> TextLearner:
    settings = TextLearnerSettings.model_validate({**SMALL, **changes})
    return settings.build(task, np.random.default_rng(0))


def flat(model: torch.nn.Module) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in model.parameters()])


def word(task: Reviews, text: str = " the") -> int:
    (token,) = task.tokenizer.encode(text, add_special_tokens=False)
    return int(token)


VARIANTS: list[dict[str, object]] = [
    {},
    {"beta": 0.0},
    {
        "advantage": "group_normalised",
        "reduction": "sequence",
        "clip": 0.2,
        "epochs": 2,
        "minibatches": 2,
        "kl_in": "advantage",
        "beta": 0.1,
    },
    {"advantage": "batch_mean", "reduction": "token", "temperature": 0.8, "kl_target": 3.0},
    {"algorithm": "ppo", "beta": 0.1, "critic": {"clip": 1.0}},
]


@pytest.mark.parametrize("changes", VARIANTS)
def test_every_variant_learns_to_say_the_rewarded_word_more_often(
    toy_reviews: Reviews, changes: dict[str, object]
) -> None:
    likes = reward(word(toy_reviews))
    one = learner(toy_reviews, updates=12, prompts=8, learning_rate=5e-3, **changes)
    before = one.evaluate(likes, np.random.default_rng(0)).metrics["learned"]
    metrics = one.improve(likes, NO_STORE, np.random.default_rng(1))
    after = one.evaluate(likes, np.random.default_rng(0)).metrics["learned"]
    assert after > before + 0.5
    assert metrics["ratio_error"] < 1e-3


@pytest.mark.parametrize("changes", VARIANTS)
def test_the_same_seed_gives_the_same_bytes_and_a_resumed_learner_goes_on_alike(
    toy_reviews: Reviews, changes: dict[str, object]
) -> None:
    likes, whole, first, second = reward(word(toy_reviews)), *(learner(toy_reviews, **changes) for _ in range(3))
    for seed in (1, 2):
        whole.improve(likes, NO_STORE, np.random.default_rng(seed))
    first.improve(likes, NO_STORE, np.random.default_rng(1))
    second.load(first.state())
    second.improve(likes, NO_STORE, np.random.default_rng(2))
    assert torch.equal(flat(whole.policy.model), flat(second.policy.model))
    assert whole.steps == second.steps
    assert whole.state()["beta"] == second.state()["beta"]


@pytest.mark.parametrize("beta", [0.0, 0.3])
def test_a_kl_that_was_not_measured_is_absent(toy_reviews: Reviews, beta: float) -> None:
    one = learner(toy_reviews, updates=2, learning_rate=5e-3, beta=beta)
    metrics = one.improve(reward(word(toy_reviews)), NO_STORE, np.random.default_rng(1))
    assert ("kl" in metrics) == (beta > 0)
    assert metrics.get("kl") != 0.0


def test_a_round_ends_where_the_policy_has_gone_too_far(toy_reviews: Reviews) -> None:
    likes = reward(word(toy_reviews))
    free = learner(toy_reviews, updates=12, prompts=8, learning_rate=5e-3, beta=0.0)
    held = learner(toy_reviews, updates=12, prompts=8, learning_rate=5e-3, beta=0.0, kl_stop=0.5)
    far, near = (one.improve(likes, NO_STORE, np.random.default_rng(1)) for one in (free, held))
    assert far["updates"] == 12
    assert 2 <= near["updates"] < 12
    assert "kl" not in far
    assert near["kl_k3"] > 0
    kl = [one.evaluate(likes, np.random.default_rng(0)).metrics["kl"] for one in (free, held)]
    assert kl[1] < 0.7 * kl[0]


def test_a_reference_that_moves_is_the_policy_in_part_and_goes_on_where_it_was(toy_reviews: Reviews) -> None:
    likes = reward(word(toy_reviews))
    changes = {"updates": 2, "learning_rate": 5e-3, "beta": 0.3, "reference_every": 2, "reference_mix": 0.25}
    one = learner(toy_reviews, **changes)
    start = one.policy.state()
    one.improve(likes, NO_STORE, np.random.default_rng(1))
    after, moved = one.policy.state(), one.state()["reference"]
    for name in start:
        torch.testing.assert_close(moved[name], 0.75 * start[name] + 0.25 * after[name])
    drawn = one.policy.respond(toy_reviews.prompts(4, np.random.default_rng(2)), 2, np.random.default_rng(3))
    other = learner(toy_reviews)
    other.policy.load(moved)
    found = one._reference_logp(drawn)
    torch.testing.assert_close(found, other.policy.logp_at(other.policy.state(), drawn))
    assert not torch.allclose(found, one.policy.start_logp(drawn), atol=1e-3)
    assert all(torch.equal(value, after[name]) for name, value in one.policy.state().items())  # only looked through
    resumed = learner(toy_reviews, **changes)
    resumed.load(one.state())
    for each in (one, resumed):
        each.improve(likes, NO_STORE, np.random.default_rng(4))
    assert torch.equal(flat(one.policy.model), flat(resumed.policy.model))


@pytest.mark.parametrize("changes", [{"beta": 0.0}, {"kl_stop": 1.0}])
def test_a_reference_that_moves_has_something_to_hold_and_stops_nothing(
    toy_reviews: Reviews, changes: dict[str, object]
) -> None:
    with pytest.raises(ValidationError, match="a reference that moves is for beta above 0"):
        learner(toy_reviews, reference_every=1, **changes)
    plain = learner(toy_reviews).state()
    with pytest.raises(ValueError, match="its reference is missing"):
        learner(toy_reviews, beta=0.1, reference_every=1).load(plain)


def test_a_reference_of_adapters_moves_all_the_way_or_not_at_all(toy_reviews: Reviews) -> None:
    with pytest.raises(ValidationError, match="set reference_mix=1"):
        learner(toy_reviews, reference_every=1, policy={"train": "lora"})
    one = learner(toy_reviews, reference_every=2, reference_mix=1.0, learning_rate=5e-3, policy={"train": "lora"})
    one.improve(reward(word(toy_reviews)), NO_STORE, np.random.default_rng(1))
    drawn = one.policy.respond(toy_reviews.prompts(4, np.random.default_rng(2)), 2, np.random.default_rng(3))
    torch.testing.assert_close(one._reference_logp(drawn), drawn.logp, atol=1e-4, rtol=1e-4)


def test_gold_is_neither_read_nor_attached_while_learning(toy_reviews: Reviews) -> None:
    blind = _WithoutGold(toy_reviews)
    seeing, unseeing = learner(toy_reviews), TextLearnerSettings(**SMALL).build(blind, np.random.default_rng(0))
    for one in (seeing, unseeing):
        one.improve(reward(word(toy_reviews)), NO_STORE, np.random.default_rng(1))
    assert torch.equal(flat(seeing.policy.model), flat(unseeing.policy.model))
    likes = Rewarded()
    seeing.improve(cast("RewardModel[Response]", likes), NO_STORE, np.random.default_rng(2))
    assert all(r.gold is None for r in likes.seen)


class _WithoutGold:
    """The same task, with every gold value replaced by NaN."""

    def __init__(self, task: Reviews) -> None:
        self.name, self.kind = task.name, task.kind
        self.tokenizer, self.response_tokens = task.tokenizer, task.response_tokens
        self.model, self.prompts, self.evaluation_prompts = task.model, task.prompts, task.evaluation_prompts
        self.fluency, self.encode, self.ends = task.fluency, task.encode, task.ends

    def gold(self, responses: Sequence[Response]) -> Floats:
        return np.full(len(responses), np.nan, np.float32)


def test_samples_come_in_groups_with_tokens_and_gold(toy_reviews: Reviews) -> None:
    found = learner(toy_reviews, asked_responses=3).sample(10, np.random.default_rng(0))
    assert len(found) == 12
    for i in range(0, 12, 3):
        assert len({r.prompt for r in found[i : i + 3]}) == 1
    for one in found:
        assert one.gold is not None
        assert one.gold.shape == (1,)
        assert one.gold[0] == toy_reviews.gold([one])[0]
        assert tuple(toy_reviews.tokenizer.encode(one.prompt)) == one.prompt_tokens
        assert toy_reviews.tokenizer.decode(list(one.tokens), skip_special_tokens=True) == one.text


def test_every_generated_token_is_counted_once_by_purpose(toy_reviews: Reviews) -> None:
    one, likes = learner(toy_reviews), Rewarded()
    found = one.sample(8, np.random.default_rng(0))
    assert one.steps == Steps(query=sum(len(r.tokens) for r in found))
    one.improve(cast("RewardModel[Response]", _counting := _Counting()), NO_STORE, np.random.default_rng(0))
    assert one.steps.learn == _counting.tokens
    one.evaluate(cast("RewardModel[Response]", likes), np.random.default_rng(0))
    assert one.steps.evaluate == sum(len(r.tokens) for r in likes.seen)


class _Counting:
    tokens = 0

    def score(self, candidates: Sequence[Response]) -> Floats:
        self.tokens += sum(len(r.tokens) for r in candidates)
        return np.arange(len(candidates), dtype=np.float32)


def test_an_evaluation_repeats_itself_and_starts_without_kl(toy_reviews: Reviews) -> None:
    one, likes = learner(toy_reviews), reward(word(toy_reviews))
    first, second = (one.evaluate(likes, np.random.default_rng(3)) for _ in range(2))
    assert first.metrics == second.metrics
    assert abs(first.metrics["kl"]) < 1e-3
    assert set(first.metrics) == {
        "gold",
        "count",
        "gold_std",
        "learned",
        "kl",
        "length",
        "ended",
        "fluency",
        "distinct_1",
        "distinct_2",
        "self_bleu",
    }
    assert len(first.examples) == 4
    assert all(r.gold is not None for r in first.examples)


def test_evaluation_does_not_change_what_is_learned(toy_reviews: Reviews) -> None:
    likes, plain, evaluated = reward(word(toy_reviews)), learner(toy_reviews), learner(toy_reviews)
    evaluated.evaluate(likes, np.random.default_rng(0))
    evaluated.sample(4, np.random.default_rng(0))
    for one in (plain, evaluated):
        one.improve(likes, NO_STORE, np.random.default_rng(1))
    assert torch.equal(flat(plain.policy.model), flat(evaluated.policy.model))


def test_the_kl_penalty_keeps_the_policy_near_its_start(toy_reviews: Reviews) -> None:
    likes, kl = reward(word(toy_reviews)), {}
    for beta in (0.0, 2.0):
        one = learner(toy_reviews, updates=12, prompts=8, learning_rate=5e-3, beta=beta)
        one.improve(likes, NO_STORE, np.random.default_rng(1))
        kl[beta] = one.evaluate(likes, np.random.default_rng(0)).metrics["kl"]
    assert kl[0.0] > 2 * max(kl[2.0], 0.1)


def test_the_reference_is_not_run_while_its_weight_is_zero(toy_reviews: Reviews) -> None:
    runs = []
    for beta in (0.0, 0.1):
        one = learner(toy_reviews, beta=beta)
        one.policy.start.register_forward_pre_hook(lambda *_: runs.append(1))
        one.policy.start.base_model.register_forward_pre_hook(lambda *_: runs.append(1))
        one.improve(reward(), NO_STORE, np.random.default_rng(0))
        assert bool(runs) == (beta > 0)


def test_a_kl_off_the_advantage_leads_a_policy_back(toy_reviews: Reviews) -> None:
    """Where all responses are worth the same, nothing else moves it."""
    away = learner(toy_reviews, updates=6, beta=0.0, learning_rate=5e-3)
    away.improve(reward(word(toy_reviews)), NO_STORE, np.random.default_rng(1))
    back = learner(toy_reviews, updates=6, kl_in="advantage", missing_end_penalty=0.0, learning_rate=2e-3)
    back.load(away.state() | {"optimizer": back.state()["optimizer"], "beta": 1.0})
    equal = reward(constant=0.0)
    before = back.evaluate(equal, np.random.default_rng(0)).metrics["kl"]
    back.improve(equal, NO_STORE, np.random.default_rng(2))
    assert back.evaluate(equal, np.random.default_rng(0)).metrics["kl"] < 0.8 * before


def test_beta_goes_down_by_as_much_as_it_may_while_the_kl_is_far_below_its_target(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, updates=1, beta=0.3, kl_target=1000.0, kl_horizon=100.0)
    one.improve(reward(word(toy_reviews)), NO_STORE, np.random.default_rng(1))
    assert one.state()["beta"] == pytest.approx(0.3 * (1 - 0.2 * 16 / 100))  # after 4 x 4 responses


def test_responses_without_an_end_are_penalised(toy_reviews: Reviews) -> None:
    """With nothing else to go by, ending is what is learned."""
    one = learner(toy_reviews, updates=10, prompts=8, learning_rate=5e-3, beta=0.0, missing_end_penalty=1.0)
    before = one.evaluate(reward(constant=0.0), np.random.default_rng(0)).metrics["ended"]
    one.improve(reward(constant=0.0), NO_STORE, np.random.default_rng(1))
    assert one.evaluate(reward(constant=0.0), np.random.default_rng(0)).metrics["ended"] > before


def test_equal_rewards_teach_nothing(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, beta=0.0, missing_end_penalty=0.0)
    before = flat(one.policy.model)
    one.improve(reward(constant=3.0), NO_STORE, np.random.default_rng(1))
    assert torch.equal(before, flat(one.policy.model))


def test_the_size_of_a_chunk_changes_the_gradient_by_rounding_only(toy_reviews: Reviews) -> None:
    results = []
    for chunk in (3, 1000):
        one = learner(toy_reviews, updates=1, policy={"chunk": chunk}, reduction="token", learning_rate=1e-9)
        metrics = one.improve(reward(word(toy_reviews)), NO_STORE, np.random.default_rng(1))
        results.append((metrics["loss"], metrics["grad_norm"]))
    np.testing.assert_allclose(results[0], results[1], rtol=1e-3, atol=1e-5)


def test_no_dropout_and_no_training_mode(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews)
    one.improve(reward(word(toy_reviews)), NO_STORE, np.random.default_rng(1))
    assert not any(m.training for m in [*one.policy.model.modules(), *one.policy.start.modules()])


def test_a_reward_that_is_not_finite_names_itself_and_the_update(toy_reviews: Reviews) -> None:
    with pytest.raises(FloatingPointError, match=r"the reward of update 0 is not finite"):
        learner(toy_reviews).improve(reward(constant=float("inf")), NO_STORE, np.random.default_rng(0))


def test_an_evaluation_is_over_what_was_scored(toy_reviews: Reviews) -> None:
    class Some:
        def score(self, candidates: Sequence[Response]) -> Floats:
            return np.array([2.0 if i % 4 else np.nan for i in range(len(candidates))], np.float32)

    found = learner(toy_reviews).evaluate(cast("RewardModel[Response]", Some()), np.random.default_rng(0)).metrics
    assert (found["learned"], found["unscored"]) == (2.0, 0.25)


def test_a_kl_off_each_token_is_that_of_it_and_what_follows(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, kl_in="token", beta=0.5, prompts=1, responses=3)
    rows = one.policy.respond(["The plot was"], 3, np.random.default_rng(0))
    scores, kl = torch.tensor([1.0, 4.0, math.nan]), torch.where(rows.mask, 0.1, 0.0)
    advantages = one._batch(rows, scores, kl)[0].advantages
    for row, lead in ((0, -3.0), (1, 3.0)):
        count = int(rows.mask[row].sum())
        expected = torch.tensor([lead - 0.5 * 0.1 * (count - t) for t in range(count)])
        torch.testing.assert_close(advantages[row, :count], expected)
    assert not advantages[~rows.mask].any()
    assert not advantages[2].any()


def test_whitened_advantages_have_mean_0_and_variance_1_over_what_was_scored(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, whiten=True, beta=0.0)
    rows = one.policy.respond(["The plot was"], 4, np.random.default_rng(0))
    known = rows.mask & torch.tensor([True, True, True, False])[:, None]
    scores, nothing = torch.tensor([1.0, 4.0, 2.0, math.nan]), torch.zeros_like(rows.logp)
    advantages = one._batch(rows, scores, nothing)[0].advantages
    assert float(advantages[known].mean()) == pytest.approx(0, abs=1e-5)
    assert float(advantages[known].var(correction=0)) == pytest.approx(1, abs=1e-4)
    assert not advantages[~known].any()
    assert float(advantages[0, rows.mask[0]].std()) == pytest.approx(0, abs=1e-6)  # of a response they stay the same


def test_a_linear_schedule_ends_each_round_at_0_and_begins_anew(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, schedule="linear", updates=4, learning_rate=0.04)
    for _ in range(2):
        rates = [one._writer.optimizer.param_groups[0]["lr"] for _ in one._writer.paced(range(4))]
        assert rates == pytest.approx([0.04, 0.03, 0.02, 0.01])
    one.improve(reward(), NO_STORE, np.random.default_rng(0))
    assert one._writer.optimizer.param_groups[0]["lr"] == pytest.approx(0.01)


@pytest.mark.parametrize("most", [1e-3, 1e3])
def test_a_step_of_sgd_is_the_gradient_as_long_as_it_may_be(toy_reviews: Reviews, most: float) -> None:
    one = learner(toy_reviews, optimizer="sgd", learning_rate=0.5, max_grad_norm=most, updates=1)
    before, likes = flat(one.policy.model), reward(word(toy_reviews))
    metrics = one.improve(likes, NO_STORE, np.random.default_rng(1))
    moved = float((flat(one.policy.model) - before).norm())
    assert moved == pytest.approx(0.5 * min(metrics["grad_norm"], most), rel=1e-4)
    resumed = learner(toy_reviews, optimizer="sgd", learning_rate=0.5, max_grad_norm=most, updates=1)
    resumed.load(one.state())
    for each in (one, resumed):
        each.improve(likes, NO_STORE, np.random.default_rng(2))
    assert torch.equal(flat(one.policy.model), flat(resumed.policy.model))


@pytest.mark.parametrize("advantage", ["leave_one_out", "group_normalised", "batch_scaled", "batch_mean", "gae"])
def test_what_no_reward_scored_teaches_nothing_and_is_counted(toy_reviews: Reviews, advantage: str) -> None:
    """As if it had never been drawn: the others learn from one another alone."""

    class Some:
        unscored = 4.0

        def score(self, candidates: Sequence[Response]) -> Floats:
            return np.array([i if i % 4 else self.unscored for i in range(len(candidates))], np.float32)

    likes, found, steps = Some(), [], []
    for likes.unscored in (float("nan"), float("nan"), 4.0):
        one = learner(toy_reviews, beta=0.0, missing_end_penalty=0.0, advantage=advantage)
        steps.append(one.improve(cast("RewardModel[Response]", likes), NO_STORE, np.random.default_rng(0)))
        found.append(flat(one.policy.model))
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])
    assert (steps[0]["unscored"], steps[2]["unscored"]) == (0.25, 0.0)
    likes.unscored, nobody = float("nan"), learner(toy_reviews, beta=0.0, advantage=advantage)
    before = flat(nobody.policy.model)
    metrics = nobody.improve(reward(constant=float("nan")), NO_STORE, np.random.default_rng(0))
    assert torch.equal(before, flat(nobody.policy.model))
    assert metrics["unscored"] == 1.0


def test_a_policy_that_is_not_the_one_that_drew_stops_the_run(
    toy_reviews: Reviews, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a decoder would that rounds otherwise than the forward pass, or reads old weights."""
    one = learner(toy_reviews)
    right = one.policy.log_prob
    monkeypatch.setattr(one.policy, "log_prob", lambda rows: (right(rows)[0] + 0.02 * rows.mask, None))
    with pytest.raises(FloatingPointError, match=r"update 0: .*ratio off by 0\.02"):
        one.improve(reward(word(toy_reviews)), NO_STORE, np.random.default_rng(0))


def test_responses_that_did_not_end_can_be_left_out(toy_reviews: Reviews) -> None:
    """Whatever they were worth: the same is learned."""

    class Worth:
        unended = 0.0

        def score(self, candidates: Sequence[Response]) -> Floats:
            ended = [c.tokens[-1] in toy_reviews.ends for c in candidates]
            return np.array([float(i) if end else self.unended for i, end in enumerate(ended)], np.float32)

    worth, found, metrics = Worth(), [], {}
    for worth.unended in (0.0, 100.0):
        one = learner(toy_reviews, beta=0.0, drop_unended=True)
        metrics = one.improve(cast("RewardModel[Response]", worth), NO_STORE, np.random.default_rng(1))
        found.append(flat(one.policy.model))
    assert torch.equal(found[0], found[1])
    assert metrics["unscored"] == pytest.approx(1 - metrics["ended"])
    assert 0 < metrics["ended"] < 1


def test_a_score_is_cut_before_anything_is_taken_off_it(toy_reviews: Reviews) -> None:
    """With equal scores after the cut, only the length is left to learn from."""

    class Wild:
        def score(self, candidates: Sequence[Response]) -> Floats:
            return np.array([100.0 + i for i in range(len(candidates))], np.float32)

    changes: dict[str, object] = {"beta": 0.0, "missing_end_penalty": 0.0, "reward_clip": 1.0}
    still, shorter = learner(toy_reviews, **changes), learner(toy_reviews, **changes, length_cost=0.1)
    before = flat(still.policy.model)
    for one in (still, shorter):
        metrics = one.improve(cast("RewardModel[Response]", Wild()), NO_STORE, np.random.default_rng(0))
    assert torch.equal(before, flat(still.policy.model))
    assert not torch.equal(before, flat(shorter.policy.model))
    assert metrics["reward"] > 100.0  # said as it was given


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"responses": 1}, "at least 2 responses"),
        ({"epochs": 2}, "need a clip"),
        ({"score": "win_rate", "algorithm": "reinforce"}, "wants advantage leave_one_out"),
        ({"algorithm": "ppo", "policy": {"shard": "fsdp2"}}, "kept whole"),
        ({"critic": {"network": "own"}}, "has no critic"),
        ({"minibatches": 1000, "clip": 0.2}, "cannot be 1000 minibatches"),
        ({"kl_target": 3.0, "beta": 0.0}, "beta must start above 0"),
    ],
)
def test_settings_that_contradict_each_other_are_errors(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        TextLearnerSettings.model_validate(changes)


def test_a_control_task_is_refused() -> None:
    class Control:
        name, kind = "pendulum", "control"

    with pytest.raises(ConfigError, match="writes text"):
        TextLearnerSettings().build(Control(), np.random.default_rng(0))


def test_a_state_of_another_size_is_refused(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews)
    state: State = one.state()
    state["model"] = {name: p[..., :1] for name, p in state["model"].items()}
    with pytest.raises(ValueError, match="other settings"):
        one.load(state)


def test_rows_and_parts_keep_what_belongs_together() -> None:
    mask = torch.tensor([[1, 1, 1], [1, 0, 0], [1, 1, 0]]).bool()
    tokens = torch.tensor([[1, 2, 3], [4, 0, 0], [5, 6, 0]])
    rows = Responses(("a", "b", "c"), ((7,), (8, 8, 8, 8), (9,)), tokens, mask, tokens * 0.1, mask[:, 2])
    assert rows.count == 6
    seen = {}
    for at, some in rows.parts(2):
        for i, j in enumerate(at.tolist()):
            seen[j] = (some.prompts[i], some.prompt_tokens[i], some.tokens[i, some.mask[i]].tolist())
    assert seen == {0: ("a", (7,), [1, 2, 3]), 1: ("b", (8, 8, 8, 8), [4]), 2: ("c", (9,), [5, 6])}
    (short,) = [some for at, some in rows.parts(1) if at.tolist() == [1]]
    assert short.tokens.shape == (1, 1)


def test_advantages_by_hand() -> None:
    returns = torch.tensor([[1.0, 3.0], [0.0, 0.0]])
    assert advantages_of(returns, "leave_one_out").tolist() == [[-2.0, 2.0], [0.0, 0.0]]
    assert advantages_of(returns, "batch_mean").tolist() == [[0.0, 2.0], [-1.0, -1.0]]
    scaled = advantages_of(torch.tensor([[1.0, 3.0], [0.0, 0.1]]), "batch_scaled")
    std = float(torch.tensor([1.0, 3.0, 0.0, 0.1]).std())
    torch.testing.assert_close(scaled, torch.tensor([[-1.0, 1.0], [-0.05, 0.05]]) / (std + 1e-4))
    assert advantages_of(torch.ones(2, 2), "batch_scaled").tolist() == [[0.0, 0.0], [0.0, 0.0]]
    torch.testing.assert_close(
        advantages_of(returns, "group_normalised"), torch.tensor([[-0.7071, 0.7071], [0.0, 0.0]]), atol=1e-3, rtol=0
    )


def test_the_formula_says_what_the_settings_say() -> None:
    plain = text_formula(TextLearnerSettings(beta=0.05))
    assert "mean_i sum_t [ log pi(y_t) A_i ]" in plain
    assert "mean of the prompt's other R_j" in plain
    assert "- 0.05 sum_t [log pi_old(y_t) - log ref(y_t)]" in plain
    other = TextLearnerSettings(
        clip=0.2, epochs=2, kl_in="advantage", beta=0.1, reduction="sequence", advantage="group_normalised"
    )
    assert "their std + 1e-4) - 0.1 (K_i - mean of the prompt's other K_j),  K_i = sum_t" in other.formula()
    assert "ref" not in text_formula(TextLearnerSettings(beta=0.0))


def test_the_formula_says_what_is_done_to_a_score() -> None:
    shaped = text_formula(TextLearnerSettings(drop_unended=True, length_cost=0.1, reward_clip=2.0, beta=0.0))
    assert "R_i = clip(score(y_i), +-2) - 0.1 tokens(y_i), of responses with an end token alone" in shaped
    ranked = text_formula(TextLearnerSettings(score="log_quantile", missing_end_penalty=0.5))
    assert "R_i = log of the share of the start's responses that score(y_i) - 0.5 [no end token] beats - " in ranked
    token = text_formula(TextLearnerSettings(kl_in="token", beta=0.1, whiten=True))
    assert "log pi(y_t) A_t" in token
    assert "- 0.1 K_t,  K_t = sum_(s >= t) [log pi_old(y_s) - log ref(y_s)];  whitened" in token
    assert "the batch's K_j" in text_formula(TextLearnerSettings(advantage="batch_mean", kl_in="advantage"))


def test_an_algorithm_fills_in_defaults_and_what_is_set_beside_it_stands() -> None:
    assert TextLearnerSettings() == TextLearnerSettings(algorithm="rloo")
    grpo = TextLearnerSettings(algorithm="grpo", kl_in="reward")
    assert (grpo.advantage, grpo.clip, grpo.kl_in, grpo.reduction) == ("group_normalised", 0.2, "reward", "sequence")
    assert TextLearnerSettings.model_validate(grpo.model_dump()) == grpo
    assert TextLearnerSettings(algorithm="reinforce").advantage == "batch_mean"


def test_a_policy_takes_over_what_was_learned_from_its_own_start_alone(toy_reviews: Reviews) -> None:
    one, adapted = learner(toy_reviews), learner(toy_reviews, policy={"train": "lora"})
    assert one.policy.start_digest() == adapted.policy.start_digest()
    one.policy.start = copy.deepcopy(one.policy.start)
    with torch.no_grad():
        next(one.policy.start.parameters())[5] += 0.01
    with pytest.raises(ValueError, match="started from other weights"):
        learner(toy_reviews).load(one.state())


@pytest.mark.parametrize(
    ("preset", "lines"),
    [
        # TRL's RLOO: the KL in the reward, before the baseline; one step without a ratio.
        ("trl-rloo", ["[ log pi(y_t) A_i ]", "A_i = R_i - mean of the prompt's other R_j", "score(y_i) - 0.05 sum_t"]),
        # OpenRLHF's: the KL of each token after the baseline, whitened, a clip over all tokens.
        ("openrlhf-rloo", ["clip(r, 0.8, 1.2)", "A_t = R_i - mean of the prompt's other R_j - 0.01 K_t", "whitened"]),
        # N+: GAE on a reward at the end and the KL of each token, values clipped, a penalty without an end.
        ("n+ppo", ["A_t = G_t, whitened", "0.95^k", "score(y_i) - 1 [no end token] - 0.05 [log pi_old", "V within"]),
    ],
)  # fmt: skip
def test_presets_are_the_formulas_of_other_systems(preset: str, lines: list[str]) -> None:
    formula = Config.load(f"text/{preset}").learner.formula()
    assert [line for line in lines if line not in formula] == []
