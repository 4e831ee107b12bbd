"""The fast environments as a stable-baselines3 `VecEnv`, for a script of your own; nothing else of prefrl is needed."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from prefrl.envs.vector import FastVectorEnv
from prefrl.types import Floats


class FastVecEnv(VecEnv):  # type: ignore[misc]  # stable-baselines3 is untyped here
    """n environments of one of `prefrl.envs.vector.NAMES`, stepped as `DummyVecEnv` steps them, only faster.

    What it returns is `DummyVecEnv`'s for the same seed, as exactly as `FastVectorEnv` is gymnasium's; of infos it has
    `terminal_observation` and `TimeLimit.truncated`. `options` are those of `FastVectorEnv`, but for `autoreset_mode`:
    a `VecEnv` begins the next episode in the same step. Raises `ValueError` for others.
    """

    def __init__(self, name: str, n_envs: int = 1, **options: Any) -> None:
        if "autoreset_mode" in options:
            raise ValueError("a VecEnv begins the next episode in the same step: leave out autoreset_mode")
        self._envs = FastVectorEnv(name, n_envs, autoreset_mode=AutoresetMode.SAME_STEP, **options)
        self._actions = np.zeros(0)
        super().__init__(n_envs, self._envs.single_observation_space, self._envs.single_action_space)

    def reset(self) -> Floats:
        if any(self._options):
            raise ValueError(f"the fast environments have no options of a reset, got {self._options}")
        observations, _ = self._envs.reset(seed=self._seeds)
        self._reset_seeds()  # they hold for one reset, as in DummyVecEnv
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Floats, Floats, np.ndarray, list[dict[str, Any]]]:
        observations, rewards, terminated, truncated, found = self._envs.step(self._actions)
        cut = truncated & ~terminated
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": value} for value in cut.tolist()]
        done = terminated | truncated
        for i in np.flatnonzero(done).tolist():
            infos[i]["terminal_observation"] = found["final_obs"][i]
        return observations, rewards.astype(np.float32), done, infos

    def close(self) -> None:
        self._envs.close()

    def get_attr(self, attr_name: str, indices: object = None) -> list[Any]:
        if attr_name == "render_mode":
            return [None] * self.num_envs
        raise AttributeError(f"the fast environments have no attribute {attr_name!r}: they are no objects each")

    def set_attr(self, attr_name: str, value: object, indices: object = None) -> None:
        raise AttributeError(f"the fast environments have no attribute {attr_name!r}: they are no objects each")

    def env_method(self, method_name: str, *args: object, indices: object = None, **kwargs: object) -> list[Any]:
        raise AttributeError(f"the fast environments have no method {method_name!r}: they are no objects each")

    def env_is_wrapped(self, wrapper_class: type, indices: object = None) -> list[bool]:
        return [False] * self.num_envs


__all__ = ["FastVecEnv"]
