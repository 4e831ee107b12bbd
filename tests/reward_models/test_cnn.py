"""Convolutional rewards, alone and with an environment whose observations are pictures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from prefrl.components import ConfigError
from prefrl.envs.control import ControlSettings, GymnasiumTask
from prefrl.fit.settings import FittingSettings
from prefrl.fit.trainer import fit_judged
from prefrl.judgements import Comparison, Judged
from prefrl.policies.rollout import Rollout, collect
from prefrl.reward_models.cnn import CNN, CNNSettings
from prefrl.reward_models.steps import StepReward
from prefrl.sample.segments import cut
from prefrl.types import Bools, Floats, Query, Segment, gold_score

IMAGE = (8, 6, 2)


class Dot(gymnasium.Env[np.ndarray, np.ndarray]):
    """A bright dot on a dark ground, pushed left and right; its column is the reward."""

    observation_space = gymnasium.spaces.Box(0, 255, IMAGE, np.uint8)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.place = int(self.np_random.integers(IMAGE[1]))
        return self._picture(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.place = int(np.clip(self.place + np.sign(action[0]), 0, IMAGE[1] - 1))
        return self._picture(), float(self.place), False, False, {}

    def _picture(self) -> np.ndarray:
        picture = np.zeros(IMAGE, np.uint8)
        picture[3:5, self.place, 0] = 255
        return picture


@pytest.fixture
def task() -> Iterator[GymnasiumTask]:
    gymnasium.register("Dot-v0", entry_point=lambda **options: Dot(), max_episode_steps=20)
    yield ControlSettings(env="Dot-v0", segment_steps=4, fps=4).build()
    del gymnasium.registry["Dot-v0"]


def _model(task: GymnasiumTask, **settings: Any) -> StepReward:
    return CNNSettings(image=IMAGE, **settings).build(task, np.random.default_rng(0))


def _rollout(task: GymnasiumTask, count: int = 8, steps: int = 60) -> Rollout:
    rng, envs = np.random.default_rng(0), task.environments(count)

    def act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
        actions = rng.uniform(-1, 1, (count, 1)).astype(np.float32)
        return actions, actions

    return collect(envs, envs.reset(rng), steps, act)[0]


def test_pictures_are_flattened_and_keep_their_order(task: GymnasiumTask) -> None:
    observations = task.environments(2).reset(np.random.default_rng(0))
    assert (task.observation_size, observations.shape) == (96, (2, 96))
    assert observations.dtype == np.float32
    pictures = observations.reshape(2, *IMAGE)
    assert (pictures[:, 3:5, :, 0].sum((1, 2)) == 2 * 255).all()
    assert observations.sum() == 4 * 255


@pytest.mark.parametrize("brightest", [255.0, None])
def test_members_in_one_pass_are_ordinary_convolutions_one_by_one(task: GymnasiumTask, brightest: float | None) -> None:
    model, rng = _model(task, brightest=brightest, channels=(3, 4), hidden=(5,)), np.random.default_rng(1)
    segments = cut(_rollout(task), 4, 6, "r", rng)
    stacked = model.stack(segments)
    assert isinstance(model.network, CNN)
    p, steps = dict(model.network.named()), stacked["inputs"].flatten(0, 1)
    pixels, actions = steps[:, :96], steps[:, 96:]
    seen = torch.from_numpy(np.concatenate([s.observations for s in segments]))
    mean, std = (0.0, 255.0) if brightest else (seen.mean(), seen.std(correction=0))
    torch.testing.assert_close(pixels, (seen - mean) / std)
    pictures = pixels.view(-1, *IMAGE).permute(0, 3, 1, 2)
    for e in range(3):
        x = pictures
        for i, size in enumerate((3, 4)):
            part = slice(e * size, (e + 1) * size)
            x = torch.nn.functional.conv2d(x, p[f"filter_{i}"][part], p[f"filter_bias_{i}"][part], 2, 1).relu()
        x = torch.cat([x.flatten(1), actions], 1)
        x = (x @ p["weight_0"][e] + p["bias_0"][e]).relu() @ p["weight_1"][e] + p["bias_1"][e]
        torch.testing.assert_close(model.scores(stacked)[e], x.view(6, 4).mean(1) * 10.0)


def test_a_reward_is_learned_from_pictures(task: GymnasiumTask) -> None:
    segments = cut(_rollout(task), 4, 240, "r", np.random.default_rng(1))
    queries = [Query((a, b)) for a, b in zip(segments[::2], segments[1::2], strict=True)]
    worth = [tuple(gold_score(c) for c in q.candidates) for q in queries]
    judged = [
        Judged(q, Comparison(q.id, 0.5 if a == b else float(a > b))) for q, (a, b) in zip(queries, worth, strict=True)
    ]
    model = _model(task, channels=(4, 8), hidden=(16,))
    fit_judged(model, judged, FittingSettings(epochs=30, learning_rate=1e-2, held_out=0), np.random.default_rng(0))
    fresh = cut(_rollout(task), 4, 100, "f", np.random.default_rng(2))
    assert np.corrcoef(model.score(fresh), [gold_score(s) for s in fresh])[0, 1] > 0.9


def test_a_later_fit_keeps_the_normaliser_of_the_first(task: GymnasiumTask) -> None:
    model = _model(task, brightest=None)
    segments = cut(_rollout(task), 4, 6, "r", np.random.default_rng(1))
    model.settle(model.stack(segments), lambda scores: scores.sum(1))
    before = model.score(segments)
    model.stack([Segment(s.observations / 2, s.actions, "x", s.start) for s in segments])
    np.testing.assert_array_equal(model.score(segments), before)


@pytest.mark.parametrize("image", [(8, 6, 1), (0, 6, 2)])
def test_pictures_of_another_size_are_refused_with_both_numbers(
    task: GymnasiumTask, image: tuple[int, int, int]
) -> None:
    wanted = f"have {np.prod(image)} numbers, but the observations of Dot-v0 have 96"
    with pytest.raises(ConfigError, match=wanted):
        CNNSettings(image=image).build(task, np.random.default_rng(0))
