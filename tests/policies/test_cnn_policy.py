"""A policy for pictures: it sees their shape, learns from them, and says what it cannot see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch

from prefrl.components import ConfigError
from prefrl.envs.control import GymnasiumTask
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.improve import control
from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.policies.cnn import CNNPolicy, CNNPolicySettings
from prefrl.policies.rollout import collect, whole_episodes
from prefrl.types import Bools, Floats

SIDE = 7
SMALL: dict[str, Any] = {"kind": "cnn", "image": (SIDE, SIDE, 1), "filters": [[8, 3, 2], [8, 3, 2]], "width": 16}


@dataclass(frozen=True)
class Dot:
    """A bright dot on a dark line, moved left or right: the gold is its closeness to the middle."""

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        return rng.integers(SIDE, size=(count, 1)).astype(np.float64)

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        moved = np.clip(states + np.where(actions.argmax(1) == 0, -1, 1)[:, None], 0, SIDE - 1)
        return moved, 1.0 - 0.4 * np.abs(moved[:, 0] - 3), np.zeros(len(states), bool)

    def observe(self, states: Floats) -> Floats:
        pictures = np.zeros((len(states), SIDE, SIDE), np.float32)
        pictures[np.arange(len(states)), :, states[:, 0].astype(int)] = 255.0
        return pictures.reshape(len(states), -1)

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray | None:
        return None


def dots(frames: int = 1) -> GymnasiumTask:
    return GymnasiumTask(
        name="Dot",
        horizon=10,
        segment_steps=5,
        observation_size=SIDE * SIDE * frames,
        action_size=2,
        action_bounds=None,
        fps=5.0,
        frame_size=16,
        make=lambda n: Vectorised(Dot(), n, 10),
    )


def test_it_learns_to_keep_a_dot_in_the_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"environments": 8, "steps_per_round": 800, "rollout_steps": 50, "minibatch": 100, "epochs": 4}
    learner: ControlLearner = ControlLearnerSettings.model_validate(
        settings | {"policy": SMALL, "discount": 0.8, "learning_rate": 3e-3, "critic_epochs": 1}
    ).build(dots(), np.random.default_rng(0))
    monkeypatch.setattr(control, "step_rewards", lambda reward: reward)
    monkeypatch.setattr(control, "learned_rewards", lambda reward, rollout: rollout.gold)
    nothing: Any = None
    for number in range(3):
        metrics = learner.improve(nothing, nothing, np.random.default_rng(number))
        assert metrics["ratio_error"] < 1e-4
    rollout = whole_episodes(dots(), learner._act(None), 20, np.random.default_rng(9))
    assert rollout.gold.sum(1).mean() > 7.0  # 7.6 at the most, about 3 for a random walk


def test_the_critics_own_epochs_leave_the_policy_alone() -> None:
    policy = CNNPolicySettings.model_validate(SMALL).build(dots(), np.random.default_rng(0))
    envs = dots().environments(2)

    def act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
        return policy.decide()(observations, np.random.default_rng(0), legal, None)[:2]

    rollout, _ = collect(envs, envs.reset(np.random.default_rng(0)), 12, act)
    reading = policy.read(rollout, None, rollout.ends)
    policy.values(reading.inputs).sum().backward()  # type: ignore[no-untyped-call]
    moved = {name for name, p in policy.named().items() if p.grad is not None and p.grad.any()}
    assert moved == {"critic_weight", "critic_bias"}
    assert reading.values.shape == (2, 12)
    torch.testing.assert_close(reading.values.flatten(), policy.values(reading.inputs)[:, 0].detach())


def test_several_frames_are_channels_and_pixels_keep_their_places() -> None:
    settings = CNNPolicySettings(image=(SIDE, SIDE, 1), filters=((4, 3, 2),), width=8)
    policy = settings.build(dots(frames=2), np.random.default_rng(0))
    assert policy.named()["filter_0"].shape == (4, 2, 3, 3)
    pixels = np.zeros((1, 2, SIDE, SIDE), np.float32)
    pixels[0, 1, 2:5, 4:7] = 255.0  # where the second filter down, third across, looks at the later frame
    flat = torch.from_numpy(pixels.reshape(1, -1))
    with torch.no_grad():
        policy.named()["width_weight"].zero_()
        policy.named()["width_weight"][:4, 5::9] = torch.eye(4)  # row 1, column 2 of each of the 3 x 3 maps
        found = policy._features(flat)[0, :4]
        expected = policy.named()["filter_0"][:, 1].sum((1, 2)).relu()
    torch.testing.assert_close(found, expected)


def test_pictures_that_do_not_fit_are_refused_and_what_fits_is_said() -> None:
    with pytest.raises(ConfigError, match=r"7 x 7 are too small for .*\[\[16, 3, 2\], \[32, 3, 2\]\]"):
        CNNPolicySettings(image=(SIDE, SIDE, 1)).build(dots(), np.random.default_rng(0))
    with pytest.raises(ConfigError, match=r"learner\.policy\.image: pictures of 8 x 7 x 1 .* have 56 .* have 49"):
        CNNPolicySettings(image=(8, 7, 1)).build(dots(), np.random.default_rng(0))


def test_the_default_is_the_network_of_mnih_and_others() -> None:
    settings = CNNPolicySettings(image=(84, 84, 4))
    assert settings.seen() == (7, 7)
    assert CNNPolicySettings(image=(36, 36, 3)).seen() == (1, 1)
    with pytest.raises(ConfigError, match="35 x 36"):
        CNNPolicySettings(image=(35, 36, 3)).seen()
    assert isinstance(CNNPolicySettings.model_validate(SMALL).build(dots(), np.random.default_rng(0)), CNNPolicy)
