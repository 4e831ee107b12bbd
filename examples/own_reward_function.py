"""A language model tuned on a reward function, with the signature that TRL's functions have (about twenty seconds).

    python examples/own_reward_function.py

Nobody is asked: this is reinforcement learning with the loop's own learner. A model of yours: docs/own_model.md.
"""

from prefrl import Config, Run
from prefrl.reward_models.functions import FunctionsSettings


def short(completions, **columns):
    """Close to eight words."""
    return [-abs(len(text.split()) - 8) / 8 for text in completions]


config = Config.load("text/toy", ["loop.labels=0", "loop.rounds=3", "learner.updates=12", "learner.beta=0.05"])
config = config.model_copy(update={"reward": FunctionsSettings.of(short)})

with Run(config, "runs/short") as run:
    for round in run:
        learned, kl = round.metrics["evaluate/learned"], round.metrics["evaluate/kl"]
        print(f"round {round.number}: reward {learned:.3f}, {kl:.2f} nats from the start")
