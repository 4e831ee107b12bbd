"""Every component makes its tensors on the one device it is given. Without a GPU: on the device of `other_device`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from other_device import ELSEWHERE, Far, assert_same, both, elsewhere, values

from prefrl.components import settings_class
from prefrl.envs.toys import PointSettings
from prefrl.fit.settings import FittingSettings
from prefrl.fit.trainer import fit_judged
from prefrl.judgements import Choice, Comparison, Judged, Ranking, Rating
from prefrl.storage.checkpoints import load_state, save_state
from prefrl.types import Query, Segment

REWARDS: dict[str, dict[str, Any]] = {
    "mlp": {"hidden": [8]},
    "cnn": {"image": [1, 2, 1], "channels": [4], "hidden": [8], "brightest": None},
    "gru": {"width": 4, "memory": 3},
    "preference_transformer": {"width": 4, "memory": 3},
    "linear": {"features": "quadratic", "members": 2},
}


ROUNDING = 1e-4
"""On the CPU small perceptrons are worked out by hand, elsewhere by torch: the last digits of a fit differ."""
TASK = PointSettings(horizon=8).build()


def reward(kind: str) -> Any:
    settings: Any = settings_class("rewards", kind)
    return settings.model_validate({"kind": kind, **REWARDS[kind]}).build(TASK, np.random.default_rng(0))


def segments(count: int) -> list[Segment]:
    rng = np.random.default_rng(1)
    lengths = [(5, 3, 4)[i % 3] for i in range(count)]
    return [
        Segment(rng.normal(size=(t, 2)).astype(np.float32), rng.normal(size=(t, 2)).astype(np.float32), "e", i)
        for i, t in enumerate(lengths)
    ]


def mixed(count: int) -> list[Judged[Segment]]:
    """Judgements of every kind, of two people, a few of them ties."""
    kinds: list[tuple[int, Any]] = [
        (2, lambda q, i: Comparison(q, (1.0, 0.0, 0.5)[i % 3], f"person {i % 2}")),
        (3, lambda q, i: Ranking(q, (0, 1, 1), f"person {i % 2}")),
        (3, lambda q, i: Choice(q, i % 3)),
        (1, lambda q, i: Rating(q, (i % 3,), 3)),
    ]
    pool, found = iter(segments(3 * count)), []
    for i in range(count):
        size, judge = kinds[i % 4]
        query = Query(tuple(next(pool) for _ in range(size)))
        found.append(Judged(query, judge(query.id, i // 4)))
    return found


FITS: dict[str, dict[str, Any]] = {
    "plain": {},
    "all that is learned beside it": {"ties": "davidson", "reliability": "learned", "centre": 0.1},
    "what nobody judged": {"pseudo_labels": 1.0, "confidence": 0.51, "crop": 0.5, "held_out": 0.3, "patience": 1},
    "errors": {"error_rate": 0.1, "rankings": "pairs", "ties": "rao_kupper", "weight_decay": "adaptive"},
    "denoised": {"denoise": "flip"},
}


@pytest.mark.parametrize(
    ("kind", "options"),
    [*((kind, FITS["plain"]) for kind in REWARDS), *(("mlp", options) for options in list(FITS.values())[1:])],
    ids=[*REWARDS, *list(FITS)[1:]],
)
def test_a_fit_stays_on_the_device_of_its_reward_model(kind: str, options: dict[str, Any]) -> None:
    unfit = Choice if options.get("ties") == "rao_kupper" else Rating if kind == "linear" else ()
    some = [one for one in mixed(24) if not isinstance(one.judgement, unfit)]
    fitting, spare = FittingSettings(epochs=2, batch_size=8, **options), segments(80)[72:]

    def fitted(device: torch.device) -> tuple[Any, Any, Any]:
        model = reward(kind)
        model.to(device)
        found = fit_judged(model, some, fitting, np.random.default_rng(0), spare)
        scored = (model.score(spare), model.raw_member_scores(spare), model.features(spare))
        rewards = model.rewards(np.ones((2, 5, 2), np.float32), np.ones((2, 5, 2), np.float32))
        return found.metrics, (*scored, rewards, found.predicted), model.state()

    here, there = both(fitted)
    assert_same(there[1], here[1], ROUNDING)
    assert_same(there[0], here[0], ROUNDING)
    assert {type(x) for x in there[2].values() if isinstance(x, torch.Tensor)} == {Far}
    assert_same(values(there[2]), values(here[2]), ROUNDING)


POLICIES: list[dict[str, Any]] = [
    {"kind": "mlp", "hidden": (8,)},
    {"kind": "cnn", "image": (1, 2, 1), "filters": [(4, 1, 1)], "width": 8},
    {"kind": "gru", "width": 6, "hidden": 5, "chunk": 3},
    {"kind": "transformer", "context": 3, "width": 6, "heads": 2, "hidden": 5, "chunk": 3},
]


def learned(settings: Any, task: Any, model: Any) -> tuple[Any, Any]:
    """The metrics and the state of a learner after a round of learning and an evaluation."""
    learner = settings.build(task, np.random.default_rng(0))
    learner.sample(4, np.random.default_rng(1))
    improved = learner.improve(model, None, np.random.default_rng(2))
    evaluated = learner.evaluate(model, np.random.default_rng(3))
    return improved | evaluated.metrics, learner.state()


@pytest.mark.parametrize("policy", POLICIES, ids=lambda policy: str(policy["kind"]))
def test_a_control_learner_keeps_to_its_device_and_learns_the_same_there(policy: dict[str, Any]) -> None:
    kind: Any = settings_class("learners", "control")
    small = {"environments": 2, "steps_per_round": 16, "rollout_steps": 8, "epochs": 1, "critic_epochs": 1}
    settings = kind(**small, minibatch=8, policy=policy, evaluation_episodes=2)

    def round_of(device: torch.device) -> tuple[Any, Any]:
        model = reward("mlp")
        model.to(device)
        model.settle(model.stack(segments(6)), lambda scores: scores.sum(1))
        return learned(settings.model_copy(update={"device": device}), TASK, model)

    here, there = both(round_of)
    assert_same(there[0], here[0], ROUNDING)
    assert_same(values(there[1]), values(here[1]), ROUNDING)
    assert {type(p) for p in there[1]["policy"]["parameters"].values()} == {Far}


def test_a_checkpoint_is_loaded_onto_the_device(tmp_path: Path) -> None:
    some, fitting = mixed(8), FittingSettings(epochs=1)

    def saved(device: torch.device) -> Any:
        model = reward("mlp")
        model.to(device)
        fit_judged(model, some, fitting, np.random.default_rng(0))
        save_state(tmp_path / device.type, "reward", model.state())
        again = reward("mlp")
        again.to(device)
        again.load(load_state(tmp_path / "cpu", "reward"))
        return again.state()

    for device in ("cpu", ELSEWHERE.type):
        (tmp_path / device).mkdir()
    here, there = both(saved)
    assert {type(x) for x in there.values() if isinstance(x, torch.Tensor)} == {Far}
    assert_same(values(there), values(here), ROUNDING)
    first, second = (values(load_state(tmp_path / name, "reward")) for name in ("cpu", ELSEWHERE.type))
    assert_same(second, first, ROUNDING)


def test_the_device_of_these_tests_refuses_tensors_of_the_cpu() -> None:
    with elsewhere() as device:
        far, near = torch.zeros(2, device=device), torch.ones(2)
        mistakes: list[Any] = [lambda: far + near, lambda: far[near.long()], lambda: near[far.long()]]
        for mistake in mistakes:
            with pytest.raises(AssertionError, match="tensors of both devices"):
                mistake()
        with pytest.raises(RuntimeError, match="numpy"):
            far.numpy()
        assert (far + near.to(device) * 2.0).tolist() == [2.0, 2.0]
