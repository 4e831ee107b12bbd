"""Classic control as `prefrl.protocols.Dynamics`: gymnasium's equations, and its states to the bit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from prefrl.envs.pictures import cartpole, finished, pendulum
from prefrl.types import Bools, Floats


@dataclass(frozen=True)
class Pendulum:
    """gymnasium's Pendulum-v1: swing up and stay up. A state is (angle, angular velocity)."""

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        high = np.array([np.pi, 1.0])
        return rng.uniform(-high, high, (count, 2))

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        angle, velocity = states.T
        # The torque stays float32, as in gymnasium: in float64 the last bits would differ.
        torque = np.clip(actions[:, 0].astype(np.float32), np.float32(-2), np.float32(2))
        wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
        costs = wrapped**2 + 0.1 * velocity**2 + 0.001 * torque**2
        # Before the angle, which moves by the new velocity, as in gymnasium.
        velocity = np.clip(velocity + (15.0 * np.sin(angle) + 3.0 * torque) * 0.05, -8.0, 8.0)
        return np.stack([angle + velocity * 0.05, velocity], 1), -costs, np.zeros(len(states), bool)

    def observe(self, states: Floats) -> Floats:
        angle, velocity = states.T
        return np.stack([np.cos(angle), np.sin(angle), velocity], 1).astype(np.float32)

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray:
        return finished(pendulum(state, size))


@dataclass(frozen=True)
class CartPole:
    """gymnasium's CartPole-v1. A state is (position, velocity, angle, angular velocity).

    Without terminations (a fixed horizon) the reward is 1 for a step that ends upright and within bounds, and 0 for
    any other; what has fallen stays as it fell. Going on with the equations instead would fill the episodes with
    spinning poles and carts hundreds of metres away, beside which the states that matter look all the same.
    """

    terminate: bool = False

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        return rng.uniform(-0.05, 0.05, (count, 4))

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        down = self._fallen(states)
        x, velocity, angle, spin = states.T
        force = np.where(actions.argmax(1) == 1, 10.0, -10.0)
        cos, sin = np.cos(angle), np.sin(angle)
        push = (force + 0.05 * np.square(spin) * sin) / 1.1
        spin_rate = (9.8 * sin - cos * push) / (0.5 * (4.0 / 3.0 - 0.1 * np.square(cos) / 1.1))
        acceleration = push - 0.05 * spin_rate * cos / 1.1
        # Each position moves by the old velocity: gymnasium's default is Euler.
        x, velocity = x + 0.02 * velocity, velocity + 0.02 * acceleration
        angle, spin = angle + 0.02 * spin, spin + 0.02 * spin_rate
        following = np.where(down[:, None], states, np.stack([x, velocity, angle, spin], 1))
        fallen = self._fallen(following)
        rewards = np.ones(len(states)) if self.terminate else 1.0 - fallen
        return following, rewards, fallen & self.terminate

    def observe(self, states: Floats) -> Floats:
        return states.astype(np.float32)

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray:
        return finished(cartpole(state, size))

    def _fallen(self, states: Floats) -> Bools:
        fallen: Bools = (np.abs(states[:, 0]) > 2.4) | (np.abs(states[:, 2]) > 12 * 2 * math.pi / 360)
        return fallen
