"""Behavioural cloning: its gradient, what it learns, corrections that help, and what it never looks at."""

from __future__ import annotations

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from control_stubs import Known, point

from prefrl import Config, Run, load_policy
from prefrl.components import ConfigError
from prefrl.envs.control import GymnasiumTask
from prefrl.envs.toys import TMazeSettings, ToyTask
from prefrl.exchange.ports import export, import_judgements
from prefrl.exchange.recordings import recording
from prefrl.improve.clone import CloneSettings
from prefrl.improve.control import ControlLearnerSettings
from prefrl.improve.gradient import Batch, update
from prefrl.improve.objectives import Objective
from prefrl.improve.offline import Offline, Recordings
from prefrl.improve.pairs import shuffled
from prefrl.judgements import Comparison, Demonstration
from prefrl.label.expert import Advice, Expert, ExpertSettings
from prefrl.policies.acting import forgetful
from prefrl.policies.rollout import whole_episodes
from prefrl.protocols import Store as Kept
from prefrl.rundir import RunError
from prefrl.stages import export_onnx, export_sb3
from prefrl.store import Store
from prefrl.types import Floats, Query, Segment, State

SMALL: dict[str, Any] = {"hidden": [16], "learning_rate": 1e-2, "evaluation_episodes": 8, "cloning_epochs": 60}


def to_the_middle(observations: Floats) -> Floats:
    """Of the point on a line: as far as one push goes."""
    found: Floats = np.clip(-5.0 * observations, -1.0, 1.0).astype(np.float32)
    return found


def push_to_the_middle(observations: Floats) -> Floats:
    found: Floats = np.eye(2, dtype=np.float32)[(observations[:, 0] < 0).astype(int)]
    return found


def learner(task: GymnasiumTask, seed: int = 0, **settings: object) -> Offline:
    return CloneSettings.model_validate(SMALL | settings).build(task, np.random.default_rng(seed))


def shown(folder: Path, task: GymnasiumTask, advice: Advice, **settings: object) -> Kept[Segment]:
    store = Store[Segment](folder)
    Expert(ExpertSettings.model_validate(settings), task, forgetful(advice)).answer(store, np.random.default_rng(1))
    return store


def gold(one: Offline) -> float:
    return one.evaluate(cast(Any, Known()), np.random.default_rng(3)).metrics["gold"]


@pytest.mark.parametrize(("discrete", "advice"), [(False, to_the_middle), (True, push_to_the_middle)])
def test_a_clone_does_what_was_shown(tmp_path: Path, discrete: bool, advice: Advice) -> None:
    task = point(discrete=discrete)
    one = learner(task)
    before = gold(one)
    metrics = one.improve(cast(Any, Known()), shown(tmp_path, task, advice, episodes=4), np.random.default_rng(0))
    assert metrics["demonstrations"] == 4
    seen = np.linspace(-1, 1, 21, dtype=np.float32)[:, None]
    actions, _ = one.actor()(seen, None, None)
    if discrete:
        assert (actions.argmax(1) == advice(seen).argmax(1))[np.abs(seen[:, 0]) > 0.3].all()
    else:
        assert np.abs(actions - advice(seen)).mean() < 0.15
    assert gold(one) > before


def test_a_pass_is_a_step_down_the_negative_log_likelihood_weighted_as_was_said(tmp_path: Path) -> None:
    """Against automatic differentiation; Adam's first step goes by the rate along the sign of the gradient."""
    task, rng = point(), np.random.default_rng(0)
    shown = [Segment(seen, to_the_middle(seen), f"e{i}", 0) for i, seen in enumerate(_seen(rng, 2, 6))]
    one = learner(task, max_grad_norm=1e9, cloning_epochs=1, cloning_minibatch=12)
    with Store[Segment](tmp_path) as store:
        queries = [Query((segment,)) for segment in shown]
        store.ask(queries)
        weights = (1.0, 3.0)
        store.answer([Demonstration(q.id, s.id, weight=w) for q, s, w in zip(queries, shown, weights, strict=True)])
        metrics = one.improve(cast(Any, Known()), store, np.random.default_rng(0))
        again = learner(task)
        again.policy.observe(np.concatenate([segment.observations for segment in shown]))
    steps = Recordings.of(shown, again.policy).decisions
    (own,), (parameter,) = one.policy.parameters(), again.policy.parameters()
    each = torch.tensor(weights).repeat_interleave(6)[:, None]
    loss = -(each * again.policy.log_prob(steps)[0]).mean()
    (by_torch,) = torch.autograd.grad(loss, parameter)
    torch.testing.assert_close(own.grad, by_torch, rtol=1e-5, atol=1e-6)
    assert metrics["cloning_loss"] == pytest.approx(float(loss.detach()) + 2.0 * again.policy.peak, rel=1e-4)


def test_a_pass_is_the_policy_gradient_with_an_advantage_of_one_to_the_bit(tmp_path: Path) -> None:
    task = point()
    one, again = (learner(task, cloning_epochs=1, cloning_minibatch=5) for _ in range(2))
    store = shown(tmp_path, task, to_the_middle, episodes=2)
    one.improve(cast(Any, Known()), store, np.random.default_rng(4))
    segments = [one.like for one in store.demonstrations()]
    again.policy.observe(np.concatenate([segment.observations for segment in segments]))
    steps = Recordings.of(segments, again.policy).decisions
    ones = torch.ones(sum(map(len, segments)), 1)
    objective = Objective(clip=None, value=0.0, entropy=0.0, max_grad_norm=1.0)
    rows = [torch.from_numpy(at) for at in shuffled(len(ones), 5, np.random.default_rng(4))]
    update(again.policy, again.optimizer, Batch(steps, torch.zeros_like(ones), ones), rows, objective)
    for own, other in zip(one.policy.parameters(), again.policy.parameters(), strict=True):
        assert torch.equal(own, other)


def _seen(rng: np.random.Generator, count: int, steps: int) -> Floats:
    found: Floats = rng.uniform(-1, 1, (count, steps, 1)).astype(np.float32)
    return found


def test_corrections_in_its_own_states_are_learned_with_what_was_shown(tmp_path: Path) -> None:
    """DAgger: the expert shows one side alone, and the learner learns the other when it is corrected there."""
    task = point()
    one, store = learner(task, cloning_epochs=200), Store[Segment](tmp_path)
    seen = np.linspace(0.2, 1.0, 20, dtype=np.float32)[:, None]
    right = Segment(seen, to_the_middle(seen), "right", 0)
    query = Query((right,))
    store.ask([query])
    store.answer([Demonstration(query.id, right.id, "expert")])
    one.improve(cast(Any, Known()), store, np.random.default_rng(0))
    left = -seen

    def error() -> float:
        actions, _ = one.actor()(left, None, None)
        return float(np.abs(actions - to_the_middle(left)).mean())

    before = error()
    store.ask([Query((Segment(left, np.zeros((20, 1), np.float32), "own", 0),))])
    Expert(ExpertSettings(episodes=0), task, forgetful(to_the_middle)).answer(store, np.random.default_rng(1))
    one.improve(cast(Any, Known()), store, np.random.default_rng(0))
    assert before > 0.5
    assert error() < 0.15


def test_the_normaliser_sees_each_demonstration_once(tmp_path: Path) -> None:
    one, store = learner(point(), cloning_epochs=1), shown(tmp_path, point(), to_the_middle, episodes=2)
    one.improve(cast(Any, Known()), store, np.random.default_rng(0))
    count = one.policy.normaliser.count
    one.improve(cast(Any, Known()), store, np.random.default_rng(0))
    assert one.policy.normaliser.count == count > 0


def test_gold_is_never_looked_at(tmp_path: Path) -> None:
    task, found = point(), list[State]()
    for name, hidden in (("seen", False), ("hidden", True)):
        store = shown(tmp_path / name, task, to_the_middle, episodes=2)
        if hidden:
            store = cast(Any, _Hidden(store))
        one = learner(task, cloning_epochs=2)
        one.improve(cast(Any, Known()), store, np.random.default_rng(0))
        found.append(one.policy.state())
    for name, weights in found[0]["parameters"].items():
        assert torch.equal(weights, found[1]["parameters"][name])


class _Hidden:
    """A store whose candidates carry a gold that is no number."""

    def __init__(self, inner: Kept[Segment]) -> None:
        self._inner = inner

    def judged(self) -> list[Any]:
        return []

    def demonstrations(self) -> list[Any]:
        inner = self._inner.demonstrations()
        return [replace(one, like=replace(one.like, gold=np.full(len(one.like), np.nan))) for one in inner]


def test_a_resumed_clone_goes_on_alike(tmp_path: Path) -> None:
    task, store = point(), shown(tmp_path, point(), to_the_middle, episodes=2)
    one = learner(task, cloning_epochs=2)
    one.improve(cast(Any, Known()), store, np.random.default_rng(0))
    other = learner(task, seed=9, cloning_epochs=2)
    other.load(deepcopy(one.state()))
    for each in (one, other):
        each.improve(cast(Any, Known()), store, np.random.default_rng(5))
    for name, weights in one.policy.state()["parameters"].items():
        assert torch.equal(weights, other.policy.state()["parameters"][name])


def test_with_nothing_shown_it_says_what_to_do(tmp_path: Path) -> None:
    with Store[Segment](tmp_path) as store, pytest.raises(ValueError, match="clone learns from demonstrations: set"):
        learner(point()).improve(cast(Any, Known()), store, np.random.default_rng(0))


def test_one_step_is_enough_to_clone(tmp_path: Path) -> None:
    seen = np.ones((1, 1), np.float32)
    one, query = learner(point(), cloning_epochs=2), Query((Segment(seen, -seen, "e", 0),))
    with Store[Segment](tmp_path) as store:
        store.ask([query])
        store.answer([Demonstration(query.id, query.candidates[0].id, "ann")])
        assert np.isfinite(one.improve(cast(Any, Known()), store, np.random.default_rng(0))["cloning_loss"])


def test_a_learned_std_narrows_where_the_expert_is_sure(tmp_path: Path) -> None:
    task, store = point(), shown(tmp_path, point(), to_the_middle, episodes=4)
    stds = []
    for learned in (False, True):
        one = learner(task, learn_std=learned)
        one.improve(cast(Any, Known()), store, np.random.default_rng(0))
        stds.append(float(one.policy.state()["parameters"]["log_std"].exp()))
    assert stds[0] == pytest.approx(0.7)
    assert stds[1] < 0.3


def test_a_learner_that_starts_from_a_clone_keeps_what_it_does_whatever_it_sees(tmp_path: Path) -> None:
    """One rollout without a gradient step once turned a good clone into a bad policy."""
    small = ["learner.cloning_epochs=1", "learner.hidden=[8]", "labeler.episodes=1", "learner.evaluation_episodes=1"]
    with Run(Config.load("control/pendulum-demos", small), tmp_path / "clone") as run:
        list(run)
    policy = {"hidden": [8], "initial_std": 0.7}
    start = ControlLearnerSettings.model_validate({"start": tmp_path / "clone", "policy": policy})
    task = cast(GymnasiumTask, run.loop.task)
    seen = np.random.default_rng(0).normal(0.0, 1.0, (20, 3)).astype(np.float32)
    expected, _ = load_policy(tmp_path / "clone").predict(seen)
    other = start.build(task, np.random.default_rng(0))
    np.testing.assert_allclose(other.actor()(seen, None, None)[0], expected, atol=1e-5)
    other.policy.observe(np.random.default_rng(0).normal(5.0, 30.0, (5000, 3)).astype(np.float32))
    np.testing.assert_allclose(other.actor()(seen, None, None)[0], expected, atol=1e-5)
    again = start.build(task, np.random.default_rng(1))
    again.load(other.state())  # nor after a resumption
    again.policy.observe(np.full((5000, 3), 90.0, np.float32))
    np.testing.assert_allclose(again.actor()(seen, None, None)[0], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("seen", "actions", "says"),
    [
        (np.ones((2, 1)), np.array([[0.5], [1.5]]), r"has the action \[1\.5\] in step 1, outside of the bounds"),
        (np.array([[0.0], [np.nan]]), np.zeros((2, 1)), "has observations that are not all finite"),
        (np.ones((2, 3)), np.zeros((2, 1)), "but .* has"),
        (np.ones((0, 1)), np.zeros((0, 1)), "has no step"),
    ],
)
def test_what_cannot_be_cloned_is_refused_by_name(tmp_path: Path, seen: Floats, actions: Floats, says: str) -> None:
    bad = Segment(seen.astype(np.float32), actions.astype(np.float32), "bad one", 0)
    query = Query((bad,))
    with Store[Segment](tmp_path) as store:
        store.ask([query])
        store.answer([Demonstration(query.id, bad.id, "ann")])
        with pytest.raises(ValueError, match=f"demonstration 'bad one' from step 0 .*{says}"):
            learner(point()).improve(cast(Any, Known()), store, np.random.default_rng(0))


def test_discrete_actions_that_are_not_one_hot_are_refused(tmp_path: Path) -> None:
    bad = Segment(np.ones((2, 1), np.float32), np.full((2, 2), 0.5, np.float32), "bad", 0)
    query = Query((bad,))
    with Store[Segment](tmp_path) as store:
        store.ask([query])
        store.answer([Demonstration(query.id, bad.id, "ann")])
        with pytest.raises(ValueError, match="not one-hot"):
            learner(point(discrete=True)).improve(cast(Any, Known()), store, np.random.default_rng(0))


@pytest.mark.parametrize("name", ["x.npz", "set"])
@pytest.mark.parametrize(("discrete", "advice"), [(False, to_the_middle), (True, push_to_the_middle)])
def test_what_left_as_a_file_and_came_back_makes_the_same_clone(
    tmp_path: Path, name: str, discrete: bool, advice: Advice
) -> None:
    if name == "set":
        pytest.importorskip("minari")
    task, found = point(discrete=discrete), list[State]()
    own = cast("Store[Segment]", shown(tmp_path / "own", task, advice, episodes=2))
    export(own, tmp_path / name, "demonstrations")
    with Store[Segment](tmp_path / "again") as again, Store[Segment](tmp_path / "nothing") as nothing:
        import_judgements(tmp_path / name, again)
        for store, data in ((own, None), (again, None), (nothing, tmp_path / name)):
            one = learner(task, cloning_epochs=2, data=data)
            one.improve(cast(Any, Known()), cast(Any, store), np.random.default_rng(0))
            found.append(one.policy.state())
    for other in found[1:]:
        for key, weights in found[0]["parameters"].items():
            assert torch.equal(weights, other["parameters"][key])


def test_what_is_asked_about_is_the_learners_own_behaviour_whatever_file_it_clones(tmp_path: Path) -> None:
    shown(tmp_path, point(), to_the_middle, episodes=2)
    one = learner(point(), data=tmp_path)
    assert one.imitates(cast(Any, None))
    asked = one.sample(3, np.random.default_rng(0))
    assert all(segment.episode.startswith("round 0") for segment in asked)


def test_only_what_was_shown_is_cloned_and_not_what_was_judged(tmp_path: Path) -> None:
    """Judged segments may be the worst ones; and of a correction the expert's actions are read, also from a folder."""
    seen = np.linspace(-1, 1, 20, dtype=np.float32)[:, None]
    own = Segment(seen, -to_the_middle(seen), "own", 0)
    like = replace(own, actions=to_the_middle(seen))
    worse = Segment(seen, -to_the_middle(seen), "worse", 0)
    with Store[Segment](tmp_path) as store:
        queries = [Query((own,)), Query((own, worse))]
        store.ask(queries)
        store.keep([like])
        store.answer([Demonstration(queries[0].id, like.id, "ann"), Comparison(queries[1].id, 1.0, "ann")])
        one = learner(point(), cloning_epochs=200)
        assert one.improve(cast(Any, Known()), store, np.random.default_rng(0))["demonstrations"] == 1
    (recorded,) = recording(tmp_path).segments
    np.testing.assert_array_equal(recorded.actions, like.actions)
    assert np.abs(one.actor()(seen, None, None)[0] - like.actions).mean() < 0.2


FLOW: dict[str, Any] = {"kind": "flow", "hidden": [16], "critic_hidden": [4], "chunk": 2, "execute": 2, "draws": 2}
GRU: dict[str, Any] = {"kind": "gru", "width": 8, "hidden": 8, "chunk": 7}
TRANSFORMER: dict[str, Any] = {"kind": "transformer", "width": 8, "heads": 2, "hidden": 8, "context": 6}


@pytest.mark.parametrize("policy", [FLOW, GRU, TRANSFORMER], ids=lambda x: x["kind"])
def test_other_policies_are_cloned_alike_from_the_same_seed_and_go_on_alike_after_a_stop(
    tmp_path: Path, policy: dict[str, Any]
) -> None:
    task, store = point(), shown(tmp_path, point(), to_the_middle, episodes=4)
    changes = {"policy": policy, "cloning_epochs": 40 if policy is FLOW else 10, "learning_rate": 1e-2}
    one, same = (CloneSettings.model_validate(changes).build(task, np.random.default_rng(0)) for _ in range(2))
    first = one.improve(cast(Any, Known()), store, np.random.default_rng(0))
    same.load(deepcopy(one.state()))
    second = [each.improve(cast(Any, Known()), store, np.random.default_rng(1)) for each in (one, same)]
    assert second[0] == second[1]
    assert second[0]["cloning_loss"] < first["cloning_loss"]
    for name, weights in one.policy.state()["parameters"].items():
        assert torch.equal(weights, same.policy.state()["parameters"][name])


def walks(task: ToyTask, count: int) -> tuple[Segment, ...]:
    """Episodes in a T-maze of one who saw the sign, and turns by it."""
    envs = task.environments(count)
    observations = envs.reset(np.random.default_rng(0))
    sign, steps = observations[:, 0], list[tuple[Floats, Floats]]()
    for left in reversed(range(task.horizon)):
        turn = np.where(sign < 0, 1, 2) if left == 0 else np.zeros(count, int)
        steps.append((observations, np.eye(3, dtype=np.float32)[turn]))
        observations = envs.step(steps[-1][1]).observations
    seen, done = (np.stack(x, 1) for x in zip(*steps, strict=True))
    return tuple(Segment(seen[i], done[i], episode=f"walk/{i}", start=0) for i in range(count))


@pytest.mark.parametrize(("policy", "gold"), [(None, 0.5), (GRU, 1.0), (TRANSFORMER, 1.0)])
def test_a_clone_with_a_memory_does_what_hangs_on_an_earlier_step(policy: dict[str, Any] | None, gold: float) -> None:
    task = TMazeSettings(length=6).build()
    changes = {"policy": policy, "cloning_epochs": 40, "cloning_minibatch": 48, "learning_rate": 1e-2, "hidden": [16]}
    one = CloneSettings.model_validate(changes).build(task, np.random.default_rng(0))
    one._data = walks(task, 16)
    one.improve(cast(Any, Known()), cast(Any, None), np.random.default_rng(0))
    rollout = whole_episodes(task, one._act(None), 40, np.random.default_rng(1))
    # Who does not remember turns one way, and half of the signs say the other one.
    assert float(rollout.gold.sum(1).mean()) == pytest.approx(gold, abs=0.25 if policy is None else 0.01)


@pytest.mark.parametrize("learns", [False, True])
def test_the_std_of_a_clone_with_a_memory_is_the_learners_and_is_learned_where_that_is_said(learns: bool) -> None:
    task, states = point(), np.linspace(-1, 1, 20, dtype=np.float32)[:, None]
    one = CloneSettings.model_validate({"policy": GRU, "std": 0.3, "learn_std": learns, "cloning_epochs": 5}).build(
        task, np.random.default_rng(0)
    )
    one._data = (Segment(states, to_the_middle(states), episode="known", start=0),)
    metrics = one.improve(cast(Any, Known()), cast(Any, None), np.random.default_rng(0))
    std = float(one.policy.named()["log_std"].detach().exp())
    assert (std == pytest.approx(0.3)) is not learns
    if not learns:  # the squared distance over twice the variance, in the mean over all steps of the last pass
        assert 0 < metrics["cloning_loss"] < 1 / (2 * 0.3**2)


@pytest.mark.parametrize(
    ("policy", "told"),
    [
        ({"width": 8}, "learner.policy.kind: missing; choose from: flow, gru, transformer"),
        ({"kind": "cnn"}, "learner.policy.kind: unknown kind 'cnn'; choose from: flow, gru, transformer"),
        ({"kind": "gru", "wdth": 8}, "learner.policy.wdth: unknown setting; did you mean 'width'?"),
        ({"kind": "gru", "width": 0}, "learner.policy.width: expected greater than or equal to 1, got 0"),
    ],
)
def test_a_mistake_in_a_clones_policy_is_told_by_its_name(policy: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Config.load("control/pendulum-demos", [f"learner.policy={json.dumps(policy)}"])
    assert str(caught.value) == told


@pytest.mark.parametrize("change", [{"initial_std": 0.5}, {"sde": True}])
def test_what_says_again_how_noisy_a_clone_is_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"std and learn_std say how noisy a clone is: leave policy\.initial_std"):
        CloneSettings.model_validate({"policy": GRU | change})


def test_a_learner_goes_on_from_a_clone_with_a_memory_and_another_one_is_refused(tmp_path: Path) -> None:
    gru = [f"learner.policy={json.dumps(GRU)}", "learner.cloning_epochs=1", "labeler.episodes=1"]
    gru += ["learner.evaluation_episodes=1", "loop.rounds=1", "loop.labels=0"]
    with Run(Config.load("control/fork-flow", gru), tmp_path / "clone") as run:
        list(run)
    settings = {"start": tmp_path / "clone", "policy": GRU}
    task, seen = run.loop.task, np.random.default_rng(0).normal(0.0, 1.0, (20, 2)).astype(np.float32)
    one = ControlLearnerSettings.model_validate(settings).build(task, np.random.default_rng(0))
    expected, memory = load_policy(tmp_path / "clone").predict(seen)
    assert memory is not None
    one.policy.observe(seen)
    found, _ = one.actor()(seen, None, None)
    np.testing.assert_array_equal(found, expected)
    for change, told in (
        ({"width": 9}, r"has learner.policy \{'width': 8\}, and here they are \{'width': 9\}: set them alike"),
        (TRANSFORMER, "expected a policy of kind transformer, and that of .* is of kind gru"),
    ):
        other = ControlLearnerSettings.model_validate(settings | {"policy": GRU | change})
        with pytest.raises(ConfigError, match=told):
            other.build(task, np.random.default_rng(0)).actor()
    with pytest.raises(ConfigError, match=r"only hold a policy of kind mlp, .* kind gru.*load_policy"):
        export_sb3(tmp_path / "clone", tmp_path / "policy.zip")


def test_a_learner_starts_from_a_cloned_flow_and_what_cannot_hold_one_is_said(tmp_path: Path) -> None:
    flow = [f"learner.policy={json.dumps(FLOW)}", "learner.cloning_epochs=1", "labeler.episodes=1"]
    with Run(Config.load("control/fork-flow", [*flow, "learner.evaluation_episodes=1"]), tmp_path / "clone") as run:
        list(run)
    settings = {"start": tmp_path / "clone", "policy": FLOW}
    task, seen = run.loop.task, np.random.default_rng(0).normal(0.0, 1.0, (20, 2)).astype(np.float32)
    learner = ControlLearnerSettings.model_validate(settings).build(task, np.random.default_rng(0))
    expected, memory = load_policy(tmp_path / "clone").predict(seen)
    assert memory is not None
    learner.policy.observe(seen)  # nothing has moved its statistics before it starts, and nothing does after
    found, _ = learner.actor()(seen, None, None)
    np.testing.assert_array_equal(found, expected)
    other = ControlLearnerSettings.model_validate(settings | {"policy": FLOW | {"chunk": 3}})
    with pytest.raises(ConfigError, match=r"has learner.policy \{'chunk': 2\}, and here they are \{'chunk': 3\}"):
        other.build(task, np.random.default_rng(0)).actor()
    with pytest.raises(ConfigError, match=r"only hold a policy of kind mlp, .* kind flow.*load_policy"):
        export_sb3(tmp_path / "clone", tmp_path / "policy.zip")
    with pytest.raises(RunError, match=r"learner\.kind=control"):
        export_onnx(tmp_path / "clone", tmp_path / "policy.onnx")
