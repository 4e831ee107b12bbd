"""One PPO update of a Llama: prefrl's text learner against the last PPO of TRL (1.12).

    python benchmarks/text_ppo.py [--size 1m|13m] [--critic shared|own] [--short]

64 prompts of 8 tokens, a response of 48 tokens to each, 2 epochs of one minibatch, GAE, whitened advantages, clipped
values, float32; see text_updates.py. With `own` both sides have a critic of the policy's size beside it, which is equal
work. With `shared` TRL's critic has the policy's trunk, and TRL runs it twice. `ratio` is peer / ours: above 1, prefrl
needs fewer CPU seconds.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from text_rloo import NEW_TOKENS, SIZES, make_model
from text_updates import Update, compare, options_of

PROMPTS, EPOCHS = 64, 2


def main() -> None:
    parser = options_of(__doc__, ".venv-peers-ppo")
    parser.add_argument("--size", choices=SIZES, default="1m")
    parser.add_argument("--critic", choices=("shared", "own"), default="shared")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        make_model(Path(folder), options.size)
        work = Update(folder, PROMPTS, 1, NEW_TOKENS, algorithm="ppo", critic=options.critic, epochs=EPOCHS)
        found = compare(work, options.peers, 5 if options.short else 20)
    said = f"one PPO update, {options.size}, critic {options.critic}, {PROMPTS} x {NEW_TOKENS} tokens, {EPOCHS} epochs"
    print(json.dumps({"name": f"text_ppo: {said}"} | found | {"short": options.short}))


if __name__ == "__main__":
    main()
