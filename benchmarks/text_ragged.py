"""One RLOO update whose responses end where they end: prefrl's text learner against TRL's trainer.

    python benchmarks/text_ragged.py [--size 1m|13m] [--short] [--peers PYTHON]

As text_rloo.py, with an end token that every token is with a chance of 1 in 24: responses have 1 to 96 tokens, 24 on
average. The sides draw responses of their own from the same distribution, so seconds are those of 1000 tokens of
responses. `ratio` is peer / ours: above 1, prefrl needs fewer.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from text_rloo import PROMPTS, SAMPLES, SIZES, make_model
from text_updates import Update, compare, options_of

NEW_TOKENS, ENDS_AFTER = 96, 24
STEP = 1e-7
"""So small that responses stay as long as they are."""


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--size", choices=SIZES, default="1m")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        make_model(Path(folder), options.size, ends_after=ENDS_AFTER)
        work = Update(folder, PROMPTS, SAMPLES, NEW_TOKENS, fixed=False, learning_rate=STEP)
        found = compare(work, options.peers, 7 if options.short else 30)
    said = f"one RLOO update, {options.size}, {PROMPTS * SAMPLES} responses of 1 to {NEW_TOKENS} tokens, fp32"
    print(json.dumps({"name": f"text_ragged: {said}"} | found | {"short": options.short}))


if __name__ == "__main__":
    main()
