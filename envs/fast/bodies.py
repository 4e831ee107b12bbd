"""What tells gymnasium's MuJoCo environments (v5) apart: first states, observations, rewards and health.

Each is gymnasium's with its default options, to the bit, over n of them at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from prefrl.types import Bools, Floats

Start = Callable[[Floats, Floats, np.random.Generator], tuple[Floats, Floats]]
"""The model's own positions and velocities -> those that an episode begins with."""


@dataclass(frozen=True)
class Snapshot:
    """n simulators as they stand. What steps them writes these arrays in place."""

    positions: Floats
    """(n, nq), of all joints."""
    velocities: Floats
    """(n, nv)"""
    derived: Floats
    """(n, E): what `Body.derived` names, in a row."""


def _first_position(now: Snapshot) -> Floats:
    return now.positions[:, 0]


def _always(now: Snapshot) -> Bools:
    return np.ones(len(now.positions), bool)


def _nothing(batch: Any) -> list[Floats]:
    return []


@dataclass(frozen=True)
class Body:
    """One environment, as functions of n bodies."""

    start: Start
    observe: Callable[[Snapshot], Floats]
    """(n, O) float64, a new array."""
    reward: Callable[[Snapshot, Floats, Floats, Bools], Floats]
    """The state after a step, its actions (n, A) float32, the speed forward (n,) and health (n,) -> (n,)."""
    healthy: Callable[[Snapshot], Bools] = _always
    """(n,): whether an episode goes on."""
    place: Callable[[Snapshot], Floats] = _first_position
    """(n,): how far a body has come, of which the speed forward is taken."""
    derived: Callable[[Any], list[Floats]] = _nothing
    """(n, .) arrays that a `mujoco.batch.Batch` keeps up to date: what else is observed or rewarded."""
    contact_forces: bool = False
    """Whether `cfrc_ext` comes after them, which MuJoCo computes only when it is asked to."""


def _noise(
    positions: Floats, velocities: Floats, rng: np.random.Generator, noise: float, normal: bool = False
) -> tuple[Floats, Floats]:
    """Uniform noise; with `normal`, that of the velocities is normal."""
    positions = positions + rng.uniform(-noise, noise, len(positions))
    count = len(velocities)
    drawn = noise * rng.standard_normal(count) if normal else rng.uniform(-noise, noise, count)
    return positions, velocities + drawn


def _length(vectors: Floats) -> Floats:
    """(n, 3) -> (n,). By a dot product each, as np.linalg.norm measures a single vector: along an axis it adds up
    squares, and is off by a last bit now and then."""
    found: Floats = np.sqrt(np.vecdot(vectors, vectors))
    return found


def _effort(actions: Floats) -> Floats:
    """(n,), in the actions' float32, as in gymnasium."""
    found: Floats = np.square(actions).sum(1)
    return found


# --- bodies that move forward ---------------------------------------------------------------------------------------


def _joints(now: Snapshot, hidden: int = 1, clip: float = np.inf) -> Floats:
    """Positions but the first `hidden`, and clipped velocities."""
    velocities = now.velocities if clip == np.inf else np.clip(now.velocities, -clip, clip)
    found: Floats = np.concatenate([now.positions[:, hidden:], velocities], 1)
    return found


def _progress(
    now: Snapshot, actions: Floats, speed: Floats, healthy: Bools, control: float, survival: float = 0.0
) -> Floats:
    """Forward speed, plus `survival` for health, minus the cost of control."""
    rewards: Floats = speed + survival * healthy - control * _effort(actions)
    return rewards


def _upright(
    now: Snapshot, height: tuple[float, float], angle: tuple[float, float], reach: float | None = None
) -> Bools:
    """Height and angle of the torso within bounds, and all but where the torso is smaller than `reach`."""
    heights, angles = now.positions[:, 1], now.positions[:, 2]
    healthy: Bools = (angle[0] < angles) & (angles < angle[1]) & (height[0] < heights) & (heights < height[1])
    if reach is None:
        return healthy
    small = (np.abs(now.positions[:, 2:]) < reach).all(1) & (np.abs(now.velocities) < reach).all(1)
    return healthy & small


def _ant_derived(batch: Any) -> list[Floats]:
    return [batch.body(1).xpos]


def _ant_place(now: Snapshot) -> Floats:
    """The torso's, which lags the first joint's position by a part of a step."""
    return now.derived[:, 0]


def _ant_contacts(now: Snapshot) -> Floats:
    """(n, 84) clipped forces and torques on each body, the world's six first."""
    return np.clip(now.derived[:, 3:], -1.0, 1.0)


def _ant_observe(now: Snapshot) -> Floats:
    contacts = _ant_contacts(now)[:, 6:]
    found: Floats = np.concatenate([now.positions[:, 2:], now.velocities, contacts], 1)
    return found


def _ant_reward(now: Snapshot, actions: Floats, speed: Floats, healthy: Bools) -> Floats:
    contact = 5e-4 * np.square(_ant_contacts(now)).sum(1)
    rewards: Floats = speed + healthy * 1.0 - (0.5 * _effort(actions) + contact)
    return rewards


def _ant_healthy(now: Snapshot) -> Bools:
    heights = now.positions[:, 2]
    finite = np.isfinite(now.positions).all(1) & np.isfinite(now.velocities).all(1)
    healthy: Bools = finite & (heights >= 0.2) & (heights <= 1.0)
    return healthy


# --- arms that reach and push ---------------------------------------------------------------------------------------


def _reacher_start(positions: Floats, velocities: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """The last two joints are the target's, which lies still within the arm's reach."""
    positions = positions + rng.uniform(-0.1, 0.1, len(positions))
    while np.linalg.norm(target := rng.uniform(-0.2, 0.2, 2)) >= 0.2:
        pass
    positions[-2:] = target
    velocities = velocities + rng.uniform(-0.005, 0.005, len(velocities))
    velocities[-2:] = 0.0
    return positions, velocities


def _reacher_derived(batch: Any) -> list[Floats]:
    return [batch.body("fingertip").xpos, batch.body("target").xpos]


def _reacher_observe(now: Snapshot) -> Floats:
    """Angles of the arm as cosines and sines, the target, the arm's velocities, and from the target to the tip."""
    angles, apart = now.positions[:, :2], now.derived[:, :2] - now.derived[:, 3:5]
    parts = [np.cos(angles), np.sin(angles), now.positions[:, 2:], now.velocities[:, :2], apart]
    found: Floats = np.concatenate(parts, 1)
    return found


def _reacher_reward(now: Snapshot, actions: Floats, speed: Floats, healthy: Bools) -> Floats:
    return -_length(now.derived[:, :3] - now.derived[:, 3:]) - _effort(actions)


def _pusher_start(positions: Floats, velocities: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """The last four joints are the object's and the goal's, which lie still and apart."""
    positions = positions.copy()
    while np.linalg.norm(place := np.array([rng.uniform(-0.3, 0.0), rng.uniform(-0.2, 0.2)])) <= 0.17:
        pass
    positions[-4:] = *place, 0.0, 0.0
    velocities = velocities + rng.uniform(-0.005, 0.005, len(velocities))
    velocities[-4:] = 0.0
    return positions, velocities


def _pusher_derived(batch: Any) -> list[Floats]:
    return [batch.body(name).xpos for name in ("tips_arm", "object", "goal")]


def _pusher_observe(now: Snapshot) -> Floats:
    found: Floats = np.concatenate([now.positions[:, :7], now.velocities[:, :7], now.derived], 1)
    return found


def _pusher_reward(now: Snapshot, actions: Floats, speed: Floats, healthy: Bools) -> Floats:
    tip, pushed, goal = now.derived[:, :3], now.derived[:, 3:6], now.derived[:, 6:]
    # In gymnasium's order, since sums of floats hang on it.
    rewards: Floats = -_length(pushed - goal) - 0.1 * _effort(actions) - 0.5 * _length(pushed - tip)
    return rewards


# --- poles on a cart ------------------------------------------------------------------------------------------------


def _pole_healthy(now: Snapshot) -> Bools:
    finite = np.isfinite(now.positions).all(1) & np.isfinite(now.velocities).all(1)
    healthy: Bools = finite & (np.abs(now.positions[:, 1]) <= 0.2)
    return healthy


def _pole_reward(now: Snapshot, actions: Floats, speed: Floats, healthy: Bools) -> Floats:
    return healthy.astype(np.float64)


def _poles_derived(batch: Any) -> list[Floats]:
    return [batch.site("tip").xpos, batch.qfrc_constraint]


def _poles_observe(now: Snapshot) -> Floats:
    """The cart's place, sines and cosines of the poles, clipped velocities, the clipped force that holds the cart."""
    angles, rest = now.positions[:, 1:], np.concatenate([now.velocities, now.derived[:, 3:4]], 1)
    parts = [now.positions[:, :1], np.sin(angles), np.cos(angles), np.clip(rest, -10.0, 10.0)]
    found: Floats = np.concatenate(parts, 1)
    return found


def _poles_reward(now: Snapshot, actions: Floats, speed: Floats, healthy: Bools) -> Floats:
    """10 while the tip is up, minus its distance to the top and the poles' speed."""
    # float_power, not a product: gymnasium squares scalars with pow(), which is off by a last bit now and then.
    x, height = np.float_power(now.derived[:, 0], 2), np.float_power(now.derived[:, 2] - 2, 2)
    inner, outer = np.float_power(now.velocities[:, 1], 2), np.float_power(now.velocities[:, 2], 2)
    return 10.0 * healthy - (0.01 * x + height) - (1e-3 * inner + 5e-3 * outer)


def _poles_healthy(now: Snapshot) -> Bools:
    healthy: Bools = ~(now.derived[:, 2] <= 1)  # a tip that is nowhere has not fallen, as in gymnasium
    return healthy


BODIES = {
    "Ant-v5": Body(
        partial(_noise, noise=0.1, normal=True),
        _ant_observe,
        _ant_reward,
        _ant_healthy,
        _ant_place,
        _ant_derived,
        contact_forces=True,
    ),
    "HalfCheetah-v5": Body(partial(_noise, noise=0.1, normal=True), _joints, partial(_progress, control=0.1)),
    "Hopper-v5": Body(
        partial(_noise, noise=5e-3),
        partial(_joints, clip=10.0),
        partial(_progress, control=1e-3, survival=1.0),
        partial(_upright, height=(0.7, np.inf), angle=(-0.2, 0.2), reach=100.0),
    ),
    "InvertedDoublePendulum-v5": Body(
        partial(_noise, noise=0.1, normal=True), _poles_observe, _poles_reward, _poles_healthy, derived=_poles_derived
    ),
    "InvertedPendulum-v5": Body(partial(_noise, noise=0.01), partial(_joints, hidden=0), _pole_reward, _pole_healthy),
    "Pusher-v5": Body(_pusher_start, _pusher_observe, _pusher_reward, derived=_pusher_derived),
    "Reacher-v5": Body(_reacher_start, _reacher_observe, _reacher_reward, derived=_reacher_derived),
    "Swimmer-v5": Body(partial(_noise, noise=0.1), partial(_joints, hidden=2), partial(_progress, control=1e-4)),
    "Walker2d-v5": Body(
        partial(_noise, noise=5e-3),
        partial(_joints, clip=10.0),
        partial(_progress, control=1e-3, survival=1.0),
        partial(_upright, height=(0.8, 2.0), angle=(-1.0, 1.0)),
    ),
}
"""By gymnasium's id."""
