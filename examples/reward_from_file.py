"""A reward model from a file of preferences, its report card, and scores for texts of one's own (about ten seconds).

python examples/reward_from_file.py [FILE.jsonl]    # lines with prompt, chosen, rejected
"""

import json
import sys
from pathlib import Path

from prefrl import Config, Response
from prefrl.rundir import open_saved
from prefrl.stages import fit_reward, report_card

if len(sys.argv) > 1:
    file = Path(sys.argv[1])
else:  # polite answers are preferred
    file = Path("preferences.jsonl")
    names = ("Ann", "Bob", "Carla", "Deniz", "Emre", "Fay", "Gus", "Hui")
    rows = [
        {
            "prompt": f"Greet {name}, the {number}th guest.",
            "chosen": f"welcome, dear {name}",
            "rejected": f"what, {name}",
        }
        for number in range(4, 14)
        for name in names
    ]
    file.write_text("".join(json.dumps(row) + "\n" for row in rows))

config = Config.load("text/toy", ["fitting.epochs=4"])
fitted, notes = fit_reward(config, file, Path("reward"))
print(f"right on held-out pairs: {fitted.metrics['accuracy_held_out']:.2f}", *notes, sep="\n")

card = report_card(Path("reward"), data=file, held_out=True)
print(f"accuracy {card.accuracy.value:.2f}, between {card.accuracy.low:.2f} and {card.accuracy.high:.2f}")

saved = open_saved("reward")
reward = saved.reward(saved.config.build_task())
answers = [Response("Greet Ida, the 20th guest.", text) for text in ("welcome, dear Ida", "what, Ida")]
print("scores:", reward.score(answers))
