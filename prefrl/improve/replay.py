"""stable-baselines3's replay buffers under a reward that changes: relabelled, cut at resets, saved and loaded."""

from __future__ import annotations

import gymnasium
import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer

from prefrl.improve.vec_env import executed, flattened, scored
from prefrl.protocols import StepRewards
from prefrl.types import Floats, State

KNOWN = (ReplayBuffer, NStepReplayBuffer, DictReplayBuffer)
"""Those that keep one transition a slot; sums over several steps are made when they are sampled."""
PIECE = 2**16
"""Transitions that are scored at once: a ring of a million is not copied whole."""
REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def relabel(buffer: ReplayBuffer, reward: StepRewards) -> None:
    """Recompute every reward of a replay buffer (Lee et al. 2021, PEBBLE, section 4.2), in place.

    The whole ring in one pass after a fit costs less than scoring what is sampled: a transition is drawn many times
    between two fits. A reward that looks back sees what the buffer still holds of its episode. Raises ValueError for
    buffers that keep something else than one transition a slot.
    """
    # Not isinstance: other subclasses make up goals, whose rewards are the environment's own.
    if type(buffer) not in KNOWN:
        names = ", ".join(kind.__name__ for kind in KNOWN)
        raise ValueError(f"relabel needs one of stable-baselines3's {names}, got {type(buffer).__name__}")
    size = buffer.size()
    # In a full ring the next slot to be overwritten is the oldest.
    oldest_first = np.roll(np.arange(size), -buffer.pos if buffer.full else 0)
    each, before = max(1, PIECE // buffer.n_envs), reward.memory - 1
    for start in range(0, size, each):
        seen = max(0, start - before)  # a reward that looks back sees as far into the piece before
        at = oldest_first[seen : start + each]
        # (T, n, .) -> (n, T, .): a row for each environment, as a reward model has it.
        parts = (x.swapaxes(0, 1) for x in (_rows(buffer, at), _actions(buffer, at), _begins(buffer, at)))
        buffer.rewards[at[start - seen :]] = scored(reward, *parts).T[start - seen :]


def cut(buffer: ReplayBuffer) -> None:
    """Say that what follows the newest step is not its future: the environments are about to be reset.

    Sums over several steps would else run on into the next episode. A time limit, so that the value of what the step
    led to still counts.
    """
    newest = (buffer.pos - 1) % buffer.buffer_size
    buffer.timeouts[newest] = np.where(buffer.dones[newest] > 0, buffer.timeouts[newest], 1.0)


def replay_state(buffer: ReplayBuffer) -> State:
    size = buffer.size()
    # What is filled, not what is allocated: a buffer may have room for a million steps.
    return {name: getattr(buffer, name)[:size].copy() for name in REPLAY} | {"pos": buffer.pos, "full": buffer.full}


def load_replay(buffer: ReplayBuffer, state: State) -> None:
    for name in REPLAY:
        values = state[name]
        if values.shape[0] > buffer.buffer_size or values.shape[1:] != getattr(buffer, name).shape[1:]:
            raise ValueError(f"replay: {name} has shape {values.shape}, which this buffer cannot hold: other settings")
        getattr(buffer, name)[: len(values)] = values
    buffer.pos, buffer.full = state["pos"], state["full"]


def _rows(buffer: ReplayBuffer, at: np.ndarray, following: bool = False) -> Floats:
    """(T, n, O) observations of some slots, or what they led to."""
    kept = buffer.next_observations if following else buffer.observations
    count = len(at) * buffer.n_envs
    if isinstance(kept, dict):
        found = {name: x[at].reshape(count, *x.shape[2:]) for name, x in kept.items()}
        return flattened(buffer.observation_space, found).reshape(len(at), buffer.n_envs, -1)
    return flattened(buffer.observation_space, kept[at].reshape(count, -1)).reshape(len(at), buffer.n_envs, -1)


def _actions(buffer: ReplayBuffer, at: np.ndarray) -> Floats:
    """(T, n, A) actions of some slots, as they were executed."""
    actions, space = buffer.actions[at], buffer.action_space
    if isinstance(space, gymnasium.spaces.Box):  # the buffer keeps actions scaled to [-1, 1]
        actions = space.low + 0.5 * (actions + 1.0) * (space.high - space.low)
    return executed(space, actions.reshape(len(at) * buffer.n_envs, -1)).reshape(len(at), buffer.n_envs, -1)


def _begins(buffer: ReplayBuffer, at: np.ndarray) -> np.ndarray:
    """(T, n) bool: whether a slot does not go on from the one before it, because of an end or of a reset."""
    previous = (at - 1) % buffer.size()
    begins: np.ndarray = (buffer.dones[previous] > 0) | (buffer.timeouts[previous] > 0)
    if not buffer.optimize_memory_usage:  # which would hold no other next observation than the next slot's
        # A reset from outside, between two calls of learn(), leaves no done behind, but the observations do not join.
        begins |= (_rows(buffer, previous, following=True) != _rows(buffer, at)).any(2)
    begins[at == (buffer.pos if buffer.full else 0)] = True  # what came before the oldest slot is gone
    return begins


__all__ = ["cut", "load_replay", "relabel", "replay_state"]
