"""Classic control as `prefrl.protocols.Dynamics`: gymnasium's equations, and its states to the bit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from prefrl.envs.pictures import acrobot, cartpole, finished, mountain_car, pendulum
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
        torque = _within(actions[:, 0].astype(np.float32), 2.0)
        wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
        costs = wrapped**2 + 0.1 * velocity**2 + 0.001 * torque**2
        # Before the angle, which moves by the new velocity, as in gymnasium.
        velocity = (velocity + (15.0 * np.sin(angle) + 3.0 * torque) * 0.05).clip(-8.0, 8.0)
        return _beside(angle + velocity * 0.05, velocity), -costs, np.zeros(len(states), bool)

    def observe(self, states: Floats) -> Floats:
        angle, velocity = states.T
        return _beside(np.cos(angle), np.sin(angle), velocity).astype(np.float32)

    def recognise(self, observations: Floats) -> Floats:
        cos, sin, velocity = observations.T
        return _beside(np.arctan2(sin, cos), velocity.clip(-8.0, 8.0))

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
        following = np.where(down[:, None], states, _beside(x, velocity, angle, spin))
        fallen = self._fallen(following)
        rewards = np.ones(len(states)) if self.terminate else 1.0 - fallen
        return following, rewards, fallen & self.terminate

    def observe(self, states: Floats) -> Floats:
        return states.astype(np.float32)

    def recognise(self, observations: Floats) -> Floats:
        return observations.astype(np.float64)

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray:
        return finished(cartpole(state, size))

    def _fallen(self, states: Floats) -> Bools:
        fallen: Bools = (np.abs(states[:, 0]) > 2.4) | (np.abs(states[:, 2]) > 12 * 2 * math.pi / 360)
        return fallen


@dataclass(frozen=True)
class Acrobot:
    """gymnasium's Acrobot-v1, with the book's equations: swing the free end above the line.

    A state is (angle of the first link, of the second relative to it, their angular velocities), and both hang at
    0. The reward is -1 for a step that ends below the line and 0 for any other. Without terminations (a fixed
    horizon) what has reached its goal stays there.
    """

    terminate: bool = False

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        return rng.uniform(-0.1, 0.1, (count, 4)).astype(np.float32).astype(np.float64)  # gymnasium rounds them

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        moved = _runge_kutta(states, actions.argmax(1) - 1.0)
        moved[:, :2] = _wrapped(moved[:, :2])
        moved[:, 2:] = np.clip(moved[:, 2:], *_SPINS)
        following = np.where(self._above(states)[:, None], states, moved)
        above = self._above(following)
        return following, above - 1.0, above & self.terminate

    def observe(self, states: Floats) -> Floats:
        """A first observation is gymnasium's to rounding only: it computes that one in float32."""
        first, second, *spins = states.T
        return _beside(np.cos(first), np.sin(first), np.cos(second), np.sin(second), *spins).astype(np.float32)

    def recognise(self, observations: Floats) -> Floats:
        cos, sin, second_cos, second_sin, *spins = observations.T
        found = _beside(np.arctan2(sin, cos), np.arctan2(second_sin, second_cos), *spins)
        found[:, 2:] = found[:, 2:].clip(*_SPINS)
        return found

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray:
        return finished(acrobot(state, size))

    def _above(self, states: Floats) -> Bools:
        above: Bools = -np.cos(states[:, 0]) - np.cos(states[:, 1] + states[:, 0]) > 1.0
        return above


_SPINS = np.array([[-4 * np.pi, -9 * np.pi], [4 * np.pi, 9 * np.pi]])
"""Bounds of Acrobot's angular velocities."""


def _runge_kutta(states: Floats, torque: Floats) -> Floats:
    """Acrobot's next states after 0.2 seconds, by one step of the classical method."""
    first = _slopes(states, torque)
    second = _slopes(states + 0.1 * first, torque)
    third = _slopes(states + 0.1 * second, torque)
    fourth = _slopes(states + 0.2 * third, torque)
    following: Floats = states + 0.2 / 6.0 * (first + 2 * second + 2 * third + fourth)
    return following


def _slopes(states: Floats, torque: Floats) -> Floats:
    """Time derivatives of Acrobot's states, with masses and lengths of 1 and gravity of 9.8."""
    angle, bend, spin, bend_spin = states.T
    cos, sin = np.cos(bend), np.sin(bend)
    inertia, coupling = 0.25 + (1.25 + cos) + 1.0 + 1.0, 0.25 + 0.5 * cos + 1.0
    outer = 4.9 * np.cos(angle + bend - np.pi / 2)
    # float_power, not a product: gymnasium squares scalars with pow(), which is off by a last bit now and then.
    turning = -0.5 * np.float_power(bend_spin, 2) * sin - bend_spin * spin * sin
    inner = turning + 1.5 * 9.8 * np.cos(angle - np.pi / 2) + outer
    pull = torque + coupling / inertia * inner - 0.5 * np.float_power(spin, 2) * sin - outer
    bend_rate = pull / (1.25 - np.float_power(coupling, 2) / inertia)
    return _beside(spin, bend_spin, -(coupling * bend_rate + inner) / inertia, bend_rate)


def _wrapped(angles: Floats) -> Floats:
    """Whole turns off, one by one, as gymnasium does it: % would differ in the last bits."""
    while (np.abs(angles) > np.pi).any():
        turns = (angles > np.pi).astype(np.float64) - (angles < -np.pi)
        angles = angles - turns * (2 * np.pi)
    return angles


@dataclass(frozen=True)
class MountainCar:
    """gymnasium's MountainCar-v0: out of the valley by swinging. A state is (position, velocity).

    The reward is -1 a step. Without terminations (a fixed horizon) what has reached its goal stays there, and the
    reward is 0 from the next step on: the return is gymnasium's.
    """

    terminate: bool = False

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        """At rest, near the lowest point."""
        return _beside(rng.uniform(-0.6, -0.4, count), np.zeros(count))

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        there = self._arrived(states)
        position, velocity = states.T
        push = (actions.argmax(1) - 1) * 0.001
        velocity = np.clip(velocity + (push + np.cos(3 * position) * -0.0025), -0.07, 0.07)
        position = np.clip(position + velocity, -1.2, 0.6)
        velocity = np.where((position == -1.2) & (velocity < 0), 0.0, velocity)
        following = np.where(there[:, None], states, _beside(position, velocity))
        return following, there - 1.0, self._arrived(following) & self.terminate

    def observe(self, states: Floats) -> Floats:
        return states.astype(np.float32)

    def recognise(self, observations: Floats) -> Floats:
        return observations.astype(np.float64).clip([-1.2, -0.07], [0.6, 0.07])

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray:
        return finished(mountain_car(state, size, goal=0.5))

    def _arrived(self, states: Floats) -> Bools:
        arrived: Bools = (states[:, 0] >= 0.5) & (states[:, 1] >= 0)
        return arrived


@dataclass(frozen=True)
class MountainCarContinuous(MountainCar):
    """gymnasium's MountainCarContinuous-v0: as MountainCar, with a force within [-1, 1] that costs its square.

    The step that reaches the goal earns 100. Without terminations (a fixed horizon) what has reached it stays there,
    and the reward is 0 from the next step on: the return is gymnasium's.
    """

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        there = self._arrived(states)
        position, velocity = states.T
        # In float32, as gymnasium keeps all states but the first of an episode, whose position has more digits.
        single, force = position.astype(np.float32), actions[:, 0].astype(np.float32)
        slope = np.where(single == position, 3 * single, 3 * position)
        push = _within(force, 1.0) * np.float32(0.0015) - (0.0025 * np.cos(slope)).astype(np.float32)
        velocity = _within(velocity.astype(np.float32) + push, 0.07)
        position = np.clip((position + velocity).astype(np.float32), np.float32(-1.2), np.float32(0.6))
        velocity = np.where((position == np.float32(-1.2)) & (velocity < 0), np.float32(0), velocity)
        following = np.where(there[:, None], states, _beside(position, velocity))
        arrived = self._arrived(following)
        rewards = np.where(there, 0.0, 100.0 * arrived - np.square(force.astype(np.float64)) * 0.1)
        return following, rewards, arrived & self.terminate

    def picture(self, state: Floats, size: int) -> np.ndarray:
        return finished(mountain_car(state, size, goal=0.45))

    def _arrived(self, states: Floats) -> Bools:
        arrived: Bools = (states[:, 0] >= np.float32(0.45)) & (states[:, 1] >= 0)
        return arrived


def _within(values: Floats, bound: float) -> Floats:
    """float32, clipped to [-bound, bound]."""
    return values.clip(np.float32(-bound), np.float32(bound))


def _beside(*columns: Floats) -> Floats:
    """(n,) each -> (n, columns) float64; as np.stack, in half its time."""
    found = np.empty((len(columns[0]), len(columns)))
    for number, column in enumerate(columns):
        found[:, number] = column
    return found
