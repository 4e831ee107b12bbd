"""What several ranks compute, for tests: cases that each rank goes through in a process of its own."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from runs import small_reviews
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.distributed.tensor import DTensor

from prefrl import distributed
from prefrl.components import settings_class
from prefrl.envs.control import ControlSettings
from prefrl.evaluate.policies import scored
from prefrl.fit.settings import FittingSettings
from prefrl.fit.trainer import fit_judged
from prefrl.improve.control import ControlLearnerSettings
from prefrl.improve.dpo import DPOSettings
from prefrl.improve.kto import KTOSettings
from prefrl.improve.online_dpo import OnlineDPOSettings
from prefrl.improve.raft import RAFTSettings
from prefrl.improve.text import TextLearnerSettings
from prefrl.judgements import Comparison, Demonstrated, Judged
from prefrl.policies.divided import Divided, environments
from prefrl.policies.rollout import collect
from prefrl.protocols import RewardModel
from prefrl.reward_models.mlp import MLPSettings
from prefrl.types import Query, Response, Segment, State

Found: TypeAlias = dict[str, Tensor]
Work: TypeAlias = Callable[..., Found]


def on_ranks(size: int, folder: Path, work: Work, *arguments: object) -> list[Found]:
    """What `work` comes to on each rank. It is a function of a module, called with the arguments."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["prefrl.rundir", "torch.utils.tensorboard", "prefrl.envs.text", "transformers"])
    folder.mkdir()
    ranks = [context.Process(target=_work, args=(rank, size, folder, work, arguments)) for rank in range(size)]
    for one in ranks:
        one.start()
    for one in ranks:
        one.join()
    assert [one.exitcode for one in ranks] == [0] * size
    return [load_file(folder / f"{rank}.safetensors") for rank in range(size)]


def _work(rank: int, size: int, folder: Path, work: Work, arguments: tuple[object, ...]) -> None:
    torch.set_num_threads(1)
    distributed.join(rank, size, (folder / "meeting").as_uri())
    with distributed.together():
        found = work(*arguments)
    save_file(found, folder / f"{rank}.safetensors")
    distributed.leave()


def pieces() -> Found:
    """What a world of ranks is made of, one by one."""
    world, calls = distributed.world(), []
    found = {"mine": torch.arange(7)[world.mine].clone(), "ranks": torch.tensor(world.gathered(world.rank))}
    for count in (0, 1, 2, 3, 7):
        rows = torch.arange(2 * count).view(count, 2)
        found[f"whole {count}"] = world.whole(rows[world.mine], count)
    weights, untouched = torch.nn.Parameter(torch.zeros(2)), torch.nn.Parameter(torch.zeros(1))
    weights.grad = torch.tensor([float(world.rank), 10.0 * (world.rank == 0)])
    world.sum_gradients([weights, untouched])
    assert weights.grad is not None
    found |= {"gradient": weights.grad, "untouched": torch.tensor([untouched.grad is None])}

    def say() -> list[int]:
        calls.append(world.rank)
        return [40 + distributed.world().rank, distributed.world().size - 1]

    def fail() -> None:
        calls.append(world.rank)
        raise ValueError(f"said by rank {world.rank}")

    found["first"] = torch.tensor(world.first(say))
    try:
        world.first(fail)
    except ValueError as error:
        found["error"] = torch.tensor(list(str(error).encode()))
    found["share"] = torch.tensor(list(world.share(7)))
    found["each"] = torch.tensor(world.each(lambda: [world.rank, distributed.world().size]))

    def fail_elsewhere() -> None:
        if world.rank == world.size - 1:
            raise ValueError(f"said by rank {world.rank}")

    try:
        world.each(fail_elsewhere)
    except ValueError as error:
        found["error of one"] = torch.tensor(list(str(error).encode()))
    return found | {"calls": torch.tensor([len(calls)])}


class Likes:
    """A reward that likes long responses, and has no score for some."""

    def score(self, candidates: list[Response]) -> Any:
        found = np.array([len(one.tokens) % 7 + 0.1 * one.tokens[0] % 3 for one in candidates], np.float32)
        return np.where([one.tokens[0] % 9 == 0 for one in candidates], np.nan, found)


LIKES: RewardModel[Response] = Likes()  # type: ignore[assignment]
BATCH = {"updates": 1, "prompts": 4, "responses": 2, "policy": {"chunk": 3}}
LEARNERS: dict[str, dict[str, Any]] = {
    "rloo": BATCH,
    "rloo, by token": BATCH | {"reduction": "token", "kl_target": 2.0},
    "rloo, without rows for some": BATCH | {"prompts": 1},
    "rloo with adapters": BATCH | {"policy": {"train": "lora", "lora_rank": 4}},
    "grpo": BATCH | {"algorithm": "grpo", "epochs": 2, "minibatches": 2},
    "ppo": BATCH | {"algorithm": "ppo", "prompts": 8, "responses": 1, "epochs": 2},
    "reinforce": BATCH | {"algorithm": "reinforce", "prompts": 5, "responses": 1},
}


def policies(cache: Path) -> Found:
    """Gradient, parameters and metrics of every learner after one round."""
    task = small_reviews(cache)
    found: Found = {}
    for name, settings in LEARNERS.items():
        learner = TextLearnerSettings.model_validate(settings).build(task, np.random.default_rng(0))
        metrics = learner.improve(LIKES, None, np.random.default_rng(1))  # type: ignore[arg-type]
        found |= dict(learned(name, learner.policy.parameters()))
        found[f"{name}: metrics"] = torch.tensor([metrics[key] for key in sorted(metrics) if key != "ratio_error"])
    raft = RAFTSettings(updates=1, prompts=5, responses=2, minibatch=3, policy={"chunk": 2})
    expert = raft.build(task, np.random.default_rng(0))
    metrics = expert.improve(LIKES, None, np.random.default_rng(1))  # type: ignore[arg-type]
    found |= dict(learned("raft", expert.policy.parameters()))
    found["raft: metrics"] = torch.tensor([metrics[key] for key in sorted(metrics)])
    for name in DIRECT:
        direct, measured = fitted(task, name, 5, {"chunk": 4})
        found |= dict(learned(name, direct.policy.parameters())) | measured
    evaluated = direct.evaluate(LIKES, np.random.default_rng(4)).metrics
    return found | {"evaluated": torch.tensor([evaluated[key] for key in sorted(evaluated)])}


SPREAD: dict[str, dict[str, Any]] = {
    "rloo": BATCH | {"policy": {"chunk": 4}, "max_grad_norm": 0.05},
    "rloo with adapters": BATCH | {"policy": {"chunk": 4, "train": "lora", "lora_rank": 4}},
    "grpo": BATCH | {"algorithm": "grpo", "epochs": 2, "minibatches": 2, "policy": {"chunk": 4}},
}


def spread_out(cache: Path) -> Found:
    """Two rounds of learners whose weights are spread over the ranks, with a pause between them."""
    task = small_reviews(cache)
    found: Found = {}
    for name, settings in SPREAD.items():
        settings = settings | {"policy": settings["policy"] | {"shard": "fsdp2"}}
        learner = TextLearnerSettings.model_validate(settings).build(task, np.random.default_rng(0))
        learner.improve(LIKES, None, np.random.default_rng(1))  # type: ignore[arg-type]
        again = TextLearnerSettings.model_validate(settings).build(task, np.random.default_rng(0))
        again.load(learner.state())
        metrics = again.improve(LIKES, None, np.random.default_rng(2))  # type: ignore[arg-type]
        found |= saved(name, again.state())
        held = [p.to_local() if isinstance(p, DTensor) else p for p in again.policy.parameters()]
        found[f"{name}: held"] = torch.tensor(sum(p.numel() for p in held))
        found[f"{name}: metrics"] = torch.tensor([metrics[key] for key in sorted(metrics) if key != "ratio_error"])
    drawn = learner.policy.respond(["The plot was"], 2, np.random.default_rng(3))  # not for all ranks
    found["one prompt"] = learner.policy.start_logp(drawn)
    for name in DIRECT:
        direct, measured = fitted(task, name, 6, {"chunk": 4, "shard": "fsdp2"})
        found |= saved(name, direct.state()) | measured
    return found


DIRECT: dict[str, Callable[..., Any]] = {
    "online": lambda minibatch, policy: OnlineDPOSettings(updates=1, prompts=9, responses=3, soft=True, policy=policy),
    "kto": KTOSettings,
    "dpo": DPOSettings,
}


def fitted(task: Any, name: str, minibatch: int, policy: dict[str, Any]) -> tuple[Any, Found]:
    """A direct method's learner and metrics after one round."""
    direct = DIRECT[name](minibatch=minibatch, policy=policy).build(task, np.random.default_rng(0))
    store = Few(direct.sample(12, np.random.default_rng(2)))
    metrics = direct.improve(LIKES, store, np.random.default_rng(3))
    # At the start all gains are 0 but for rounding, which then decides who gained more.
    return direct, {f"{name}: metrics": torch.tensor([metrics[key] for key in sorted(metrics) if key != "accuracy"])}


def saved(name: str, state: State) -> Found:
    """What was learned, and what the optimiser knows of it."""
    held = state["optimizer"]["state"]
    found = {"parameters": list(state["model"].values()), "moments": [one["exp_avg"] for one in held.values()]}
    return {f"{name}: {what}": torch.cat([one.flatten() for one in tensors]) for what, tensors in found.items()}


class Few:
    """A store of pairs in which the first is better."""

    def __init__(self, responses: list[Response]) -> None:
        queries = [Query((a, b)) for a, b in zip(responses[::2], responses[1::2], strict=True) if a.id != b.id]
        self._judged = [Judged(query, Comparison(query.id, 1.0)) for query in queries]

    def judged(self, upto: int | None = None) -> list[Judged[Response]]:
        return self._judged

    def demonstrations(self, upto: int | None = None) -> list[Demonstrated[Response]]:
        return []


def rewards(cache: Path) -> Found:
    """Parameters and metrics of fits: for text and for control, of one member and of three."""
    found: Found = {}
    pairs = Few(
        TextLearnerSettings().build(small_reviews(cache), np.random.default_rng(0)).sample(24, _seeded())
    ).judged()
    for members in (1, 3):
        for kind, task, judged, fitting in (
            ("transformer", small_reviews(cache), pairs, FittingSettings(epochs=1)),
            ("mlp", ControlTask(), planted_pairs(30), FittingSettings(epochs=1, centre=0.01, reliability="learned")),
        ):
            settings: Any = settings_class("rewards", kind)
            reward = settings(members=members).build(task, np.random.default_rng(0))
            fitted = fit_judged(reward, judged, fitting, np.random.default_rng(1))
            found |= dict(learned(f"{kind} of {members}", [p for p in reward.parameters() if p.requires_grad]))
            values = [fitted.metrics[key] for key in sorted(fitted.metrics)]
            found[f"{kind} of {members}: metrics"] = torch.tensor(values)
            if kind == "transformer":  # one response, which not every rank has
                found[f"{kind} of {members}: one"] = torch.from_numpy(scored(reward, pairs[0].query.candidates[:1]))
    return found


WORLDS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "bodies": ({"env": "InvertedPendulum-v5"}, {}),
    "bodies with a memory": ({"env": "InvertedPendulum-v5", "hide": [2, 3]}, {"kind": "gru", "width": 8, "chunk": 4}),
    "any environment": ({"env": "Pendulum-v1", "options": {"g": 9.0}}, {}),
    "in NumPy": ({"env": "CartPole-v1"}, {"hidden": [8]}),
}
"""Tasks of control, and policies for them."""


def controls() -> Found:
    """Parameters, segments, metrics and steps of a learner of control after two rounds; and how a fault comes out."""
    found: Found = {}
    for name, (world, policy) in WORLDS.items():
        task = ControlSettings.model_validate({"horizon": 12, "segment_steps": 3, **world}).build()
        settings = {"environments": 5, "steps_per_round": 100, "rollout_steps": 10, "minibatch": 20, "epochs": 2}
        learner = ControlLearnerSettings.model_validate(
            settings | {"evaluation_episodes": 3, "critic_epochs": 1, "policy": policy}
        ).build(task, np.random.default_rng(0))
        reward = MLPSettings(hidden=(8,)).build(task, np.random.default_rng(1))
        for number in range(2):
            segments = learner.sample(20, np.random.default_rng([2, number]))
            rng = np.random.default_rng([3, number])
            metrics = learner.improve(reward, None, rng)  # type: ignore[arg-type]
            evaluated = learner.evaluate(reward, np.random.default_rng(4)).metrics
            found[f"{name}: metrics {number}"] = torch.tensor([*metrics.values(), *evaluated.values()])
            found[f"{name}: drawn {number}"] = torch.tensor(rng.random(2))
            found[f"{name}: segments {number}"] = torch.tensor([list(bytes.fromhex(one.id)) for one in segments])
        found[f"{name}: parameters"] = torch.cat([p.detach().flatten() for p in learner.policy.parameters()])
        found[f"{name}: steps"] = torch.tensor(learner.steps)
    return found | _fault()


def _fault() -> Found:
    """Which of five environments are this rank's, and what is said where the last one goes wrong."""
    task = ControlSettings(env="Pendulum-v1", options={"g": 9.0}, segment_steps=3).build()
    envs, actions = environments(task, 5), np.zeros((5, 1), np.float32)
    own = np.arange(5)[envs.mine] if isinstance(envs, Divided) else np.arange(5)
    if 4 in own:
        actions[4] = np.nan
    try:
        collect(envs, envs.reset(np.random.default_rng(0)), 4, lambda *_: (actions, actions))
    except FloatingPointError as error:
        return {"own": torch.from_numpy(own), "fault": torch.tensor(list(str(error).encode()))}
    return {}


class ControlTask:
    """Enough of one to build a reward model for."""

    name, kind, observation_size, action_size, segment_steps, action_bounds = "planted", "control", 3, 2, 5, None


def planted_pairs(count: int) -> list[Judged[Segment]]:
    """Segments of different lengths, of which the one that observed more is better."""
    rng, found = _seeded(), []

    def segment(name: str, steps: int) -> Segment:
        observations, actions = (rng.normal(size=(steps, width)).astype(np.float32) for width in (3, 2))
        return Segment(observations, actions, name, 0)

    for number in range(count):
        query = Query((segment(f"{number}-a", 5), segment(f"{number}-b", 3 + number % 3)))
        a, b = (one.observations.sum() for one in query.candidates)
        found.append(Judged(query, Comparison(query.id, float(a > b), labeler=f"{number % 2}")))
    return found


def _seeded() -> np.random.Generator:
    return np.random.default_rng(5)


def learned(name: str, parameters: list[torch.nn.Parameter]) -> Iterator[tuple[str, Tensor]]:
    yield f"{name}: parameters", torch.cat([p.detach().flatten() for p in parameters])
    yield (
        f"{name}: gradient",
        torch.cat([torch.zeros(p.numel()) if p.grad is None else p.grad.flatten() for p in parameters]),
    )
