"""A policy for control from comparisons alone, round by round (a few seconds; "control/pendulum" takes a minute).

python examples/control_from_preferences.py [PRESET]
"""

import sys

from prefrl import Config, Run, load_policy

preset = sys.argv[1] if len(sys.argv) > 1 else "control/toy"
config = Config.load(preset, ["seed=1", "loop.labels=100"])

with Run(config, "runs/from-preferences") as run:
    for round in run:  # sample, ask, label, fit, improve, evaluate: all is on disk before the next round begins
        answered, gold = round.metrics.get("label/answered", 0), round.metrics["evaluate/gold"]
        print(f"round {round.number}: {answered:.0f} answers, gold {gold:.2f}")
    print("report:", run.report())

policy = load_policy("runs/from-preferences")
observation = [0.0] * run.loop.task.observation_size
action, _ = policy.predict(observation)
print("what it does at zero:", action)
