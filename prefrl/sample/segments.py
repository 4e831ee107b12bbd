"""Segments: where a rollout may be cut, and the first rollout of a starting policy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from prefrl.policies.divided import environments
from prefrl.policies.rollout import Act, Rollout, collect, joined
from prefrl.protocols import ControlTask, Mixed, OfEnvironment
from prefrl.types import Floats, Segment

OVERLAP = 24
"""How many segments of a first pool share a step, on average. A first pool is dense on purpose: docs/decisions.md."""
PATIENCE = 4
"""A first pool is given up after this many times the steps of as many segments that share none."""


def windows(rollout: Rollout, length: int) -> tuple[np.ndarray, Floats]:
    """Where segments of `length` steps may start, as (W, 2) pairs (environment, step), and a weight (W,) for each.

    A window lies inside one episode; the last start is included. The first and last window of an episode weigh as
    much as `length` others: its edges would else be seen `length` times less often than its middle. Windows in which
    nothing is seen to move are all alike, and those of one episode together weigh as much as one: else the rest that
    follows an early end would be most of what is asked about.
    """
    ends, begins = rollout.ends, rollout.begins
    episode = begins.cumsum(1)  # (n, T): steps of one episode have one number
    last = ends.shape[1] - length
    if last < 0:
        return np.zeros((0, 2), np.int64), np.zeros(0)
    inside = episode[:, : last + 1] == episode[:, length - 1 :]  # (n, last + 1)
    starts = np.argwhere(inside)
    env, t = starts.T
    at_edge = begins[env, t] | ends[env, t + length - 1]
    weights = np.where(at_edge, float(length), 1.0)
    at_rest = _at_rest(rollout.observations, length)[env, t]
    _, which, counts = np.unique(
        np.stack([env, episode[env, t]], 1)[at_rest], axis=0, return_inverse=True, return_counts=True
    )
    weights[at_rest] = 1.0 / counts[which]
    return starts, weights


def _at_rest(observations: Floats, length: int) -> np.ndarray:
    """(n, W): whether all observations of the window that starts there are the same; never where it is one step."""
    moves = (observations[:, 1:] != observations[:, :-1]).any(-1)  # (n, T - 1)
    moved = np.pad(moves.cumsum(1), ((0, 0), (1, 0)))  # (n, T): how often until there
    found: np.ndarray = moved[:, length - 1 :] == moved[:, : moved.shape[1] - length + 1]
    return found & (length > 1)


def cut(rollout: Rollout, length: int, count: int, name: str, rng: np.random.Generator) -> list[Segment]:
    """`count` distinct segments of a rollout, oldest first, gold attached, drawn by the weights of `windows`."""
    starts, weights = windows(rollout, length)
    if len(starts) < count:
        raise ValueError(
            f"{rollout.ends.size} steps hold {len(starts)} segments of {length} steps within one episode, but {count} "
            "were asked for; lower loop.pool or the segment length, or raise learner.steps_per_round"
        )
    chosen = rng.choice(len(starts), count, replace=False, p=weights / weights.sum())
    # Oldest first, so that a selector can take the newest from the end.
    by_time = starts[chosen][np.argsort(starts[chosen, 1], kind="stable")]
    return [segment(rollout, int(env), int(t), length, name) for env, t in by_time]


def segment(rollout: Rollout, env: int, t: int, length: int, name: str) -> Segment:
    """Steps t ... t + length - 1 of one environment, by value; `name` makes its episode's name unique in a run."""
    before = np.flatnonzero(rollout.ends[env, :t])
    begin = int(before[-1]) + 1 if len(before) else 0
    part = (env, slice(t, t + length))
    return Segment(
        # By value: a view would keep the whole rollout in memory for as long as the segment is.
        observations=rollout.observations[part].copy(),
        actions=rollout.actions[part].copy(),
        episode=f"{name}/{env}/{begin}",
        start=t - begin,
        states=None if rollout.states is None else rollout.states[part].copy(),
        gold=rollout.gold[part].copy(),
    )


def first_episodes(task: ControlTask, rollout: Rollout, names: Sequence[str]) -> list[Segment]:
    """The first episode of each of n environments, whole; a row may go on after it. `names` are as in `segment`."""
    lengths = rollout.ends.argmax(1) + 1
    return placed(task, [segment(rollout, i, 0, int(n), names[i]) for i, n in enumerate(lengths)])


def piece(one: Segment, start: int, length: int) -> Segment:
    """Some steps of a segment, with their states and gold."""
    part = slice(start, start + length)
    states, gold = (None if x is None else x[part] for x in (one.states, one.gold))
    return Segment(one.observations[part], one.actions[part], one.episode, one.start + start, states, gold, one.context)


def placed(task: ControlTask, segments: Sequence[Segment]) -> list[Segment]:
    """Segments that are of one of several tasks, each in the context of its own."""
    if not isinstance(task, Mixed):
        return list(segments)
    return [replace(one, context=task.names[int(task.which(one.observations[0]))]) for one in segments]


def first_rollout(task: ControlTask, act: Act, count: int, most: int, rng: np.random.Generator) -> Rollout:
    """What a starting policy does: `count` windows in count * segment_steps / OVERLAP steps, or in more.

    It takes `horizon` steps at a time in each of at most `most` environments. Raises ValueError where episodes end too
    early to hold that many windows.
    """
    episodes = max(1, math.ceil(count * task.segment_steps / (OVERLAP * task.horizon)))
    # As many equal passes as it takes, over no more environments than are needed to fill them.
    passes = math.ceil(episodes / most)
    n = math.ceil(episodes / passes)
    envs, parts, held, longest = environments(task, n), list[Rollout](), 0, 0
    observations, age = envs.reset(rng), np.zeros(n, np.int64)
    while len(parts) < passes or held < count:
        if len(parts) >= PATIENCE * OVERLAP * passes:
            raise ValueError(_too_short(task, sum(p.ends.size for p in parts), held, count, longest))
        begins = parts[-1].ends[:, -1] if parts else None
        rollout, observations = collect(envs, observations, task.horizon, act, begins)
        parts.append(rollout)
        ages = _ages(rollout.ends, age)
        held += int((ages >= task.segment_steps).sum())  # so many windows end here
        age, longest = np.where(rollout.ends[:, -1], 0, ages[:, -1]), max(longest, int(ages.max()))
    return joined(parts)


def _ages(ends: np.ndarray, before: np.ndarray) -> np.ndarray:
    """(n, T): which step of its episode each is, from 1, where `before` (n,) steps came earlier."""
    at = np.arange(ends.shape[1])
    begins = np.where(np.roll(ends, 1, 1), at, -before[:, None])  # the roll wraps to column 0, set below
    begins[:, 0] = -before
    ages: np.ndarray = at + 1 - np.maximum.accumulate(begins, 1)
    return ages


def _too_short(task: ControlTask, steps: int, held: int, count: int, longest: int) -> str:
    ends = isinstance(task, OfEnvironment) and task.variable_horizon
    fixed = ", or leave task.variable_horizon at false, so that episodes do not end early" if ends else ""
    return (
        f"{steps} steps of the starting policy hold {held} segments of {task.segment_steps} steps within one episode, "
        f"but {count} were asked for; the longest episode seen had {longest} steps: make task.segment_seconds (or "
        f"segment_steps) smaller{fixed}"
    )
