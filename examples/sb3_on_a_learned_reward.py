"""A script for stable-baselines3 whose reward was learned from comparisons (about twenty seconds).

    python examples/sb3_on_a_learned_reward.py

The replay buffer is relabelled when the reward model has learned more; without that SAC learns from stale rewards.
"""

from pathlib import Path

from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

from prefrl import Config
from prefrl.improve.sb3 import LearnedReward, relabel
from prefrl.store import Store

config = Config.load("control/pendulum", ["loop.rounds=2", "loop.labels=60", "learner.steps_per_round=1920"])
with Store(Path("pendulum-labels")) as store:
    loop = config.build(store)
    rounds = loop.run()
    next(rounds), next(rounds)  # the starting policy; then the first questions, and a fit

    env = LearnedReward(make_vec_env("Pendulum-v1", n_envs=2, seed=0), loop.reward)  # the true reward is dropped
    model = SAC("MlpPolicy", env, buffer_size=10_000, learning_starts=100, seed=0, device="cpu")
    model.learn(300)

    next(rounds)  # more questions, and another fit
    relabel(model.replay_buffer, loop.reward)
    model.learn(300, reset_num_timesteps=False)
model.save("pendulum.zip")
print("pendulum.zip: SAC after", model.num_timesteps, "steps; more steps make it a policy")
