"""The README.md that a reward model or a policy carries when it leaves: the Hub's fields on top, its report below.

It is made from a folder's files alone, as the report is, and nothing is uploaded. The fields are those of the model
cards of Hugging Face, with the results as a `model-index`.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml

from prefrl.kinds import Kind, named
from prefrl.report.card_words import groups
from prefrl.report.card_words import headline as card_headline
from prefrl.report.card_words import subject as card_subject
from prefrl.report.facts import Facts, gather
from prefrl.report.records import MAX_CONFIG, Record, mapping, read, visible
from prefrl.report.words import headline, show_number, show_share, verdict
from prefrl.storage.files import README, write_file
from prefrl.types import Json

USES = {
    "reward": (
        "prefrl",
        "bash",
        "prefrl evaluate --reward {to} --data FOLDER_OR_FILE\nprefrl improve PRESET --reward {to}",
    ),
    "classifier": (
        "transformers",
        "python",
        "from transformers import AutoModelForSequenceClassification\n\n"
        "model = AutoModelForSequenceClassification.from_pretrained({to})  # its logit is the score",
    ),
    "policy": (
        "transformers",
        "python",
        "from transformers import AutoModelForCausalLM, AutoTokenizer\n\n"
        "model = AutoModelForCausalLM.from_pretrained({to})\ntokenizer = AutoTokenizer.from_pretrained({to})",
    ),
    "adapter": (
        "peft",
        "python",
        "from peft import AutoPeftModelForCausalLM\n\nmodel = AutoPeftModelForCausalLM.from_pretrained({to})",
    ),
    "sb3": ("stable-baselines3", "python", "from prefrl import load_policy\n\npolicy = load_policy({to})"),
    "onnx": ("onnx", "python", "import onnxruntime\n\nsession = onnxruntime.InferenceSession({to})"),
}
"""What a model was written as -> the library that reads it, and how."""
JUDGES = ("reward", "classifier")
"""Those are reward models, the others policies."""


def write_readme(source: Path, to: Path, form: str, kind: str, best: bool = False) -> Path:
    """Write the README of `to`, which was made from the folder `source` as `form` says; returns where it lies.

    A folder has it as its README.md, a file beside itself, with `.md` after its name. `kind` is that of the candidates;
    `best` says that it is the best policy, which the run's last evaluation is not of.
    """
    record = read(source, examples=False)
    card = Card(
        record, gather(record), mapping(yaml.safe_load(record.config)), visible(to.name, 200), form, named(kind), best
    )
    path = to / README if to.is_dir() else to.with_name(f"{to.name}.md")
    write_file(path, card.text().encode())
    return path


@dataclass(frozen=True)
class Card:
    """The card of one model."""

    record: Record
    facts: Facts
    settings: Json
    name: str
    form: str
    kind: Kind[Any]
    best: bool

    def text(self) -> str:
        parts = [*(self._judge() if self.form in JUDGES else self._policy()), self._made(), self._use()]
        return f"---\n{yaml.safe_dump(self._fields(), sort_keys=False)}---\n\n" + "\n\n".join(parts) + "\n"

    def _fields(self) -> Json:
        judges = self.form in JUDGES
        pipeline = self.kind.pipelines[0 if judges else 1]
        tags = ["prefrl", "preference-learning", "reward-model" if judges else "rlhf"]
        fields: Json = {"library_name": USES[self.form][0], "pipeline_tag": pipeline, "tags": tags}
        base = str(mapping(self.settings.get("task")).get("model") or "")
        if re.fullmatch(r"[\w.-]+/[\w.-]+", base) and not Path(base).exists():  # a name of the Hub, and no folder here
            fields["base_model"] = base
        if metrics := list(self._judged() if judges else self._gained()):
            result = {"task": {"type": pipeline}, "dataset": self._dataset(), "metrics": metrics}
            fields["model-index"] = [{"name": self.name, "results": [result]}]
        return fields

    def _dataset(self) -> Json:
        if self.form in JUDGES and self.record.card:
            return {"name": visible(self.record.card.about.data, 200), "type": "preferences"}
        task = mapping(self.settings.get("task"))
        name = visible(task.get("env") or task.get("kind"), 200)
        return {"name": name, "type": name}

    def _judged(self) -> Iterable[Json]:
        """The report card's numbers of a reward model."""
        if self.record.card is None:
            return
        card = self.record.card
        which = "held-out comparisons" if card.about.held_out else "comparisons"
        for kind, name, found in (
            ("accuracy", f"accuracy on {which}", card.accuracy),
            ("log_loss", f"log-loss on {which}, nats", card.calibration.log_loss),
            ("calibration_error", "expected calibration error", card.calibration.error),
            ("spearmanr", "rank correlation with gold", card.gold.spearman),
        ):
            if found.value is not None:
                yield {"type": kind, "name": name, "value": round(found.value, 4)}

    def _gained(self) -> Iterable[Json]:
        """The numbers of a policy's last evaluation."""
        if self.best:
            return
        after, spread = self.facts.gold[1], self.facts.gold_spread[1]
        if after is not None and not self.kind.stepwise:
            yield {"type": "gold", "name": f"mean gold of a {self.kind.noun}", "value": round(after, 4)}
        elif after is not None:
            value = f"{after:.2f}" + (f" +/- {spread:.2f}" if spread is not None else "")
            yield {"type": "mean_reward", "name": "mean_reward", "value": value}
        if self.facts.won is not None and self.facts.won.value is not None:
            won = round(self.facts.won.value, 4)
            yield {"type": "win_rate", "name": "win rate against the start, by the reward model", "value": won}

    def _judge(self) -> Iterable[str]:
        yield f"# {_plain(self.name)}: a reward model from preferences"
        if self.record.card is None:
            yield "No judgement was held out, so it was not graded."
            return
        yield f"{card_headline(self.record.card)} {_plain(card_subject(self.record.card.about))}."
        rows = [
            f"| {group}: {_plain(row.name)} | {_plain(row.value) or '–'} | {_plain(row.note)} |"
            for group, found in groups(self.record.card)
            if group != "Labelers"  # who answered is nobody's business but the project's
            for row in found
        ]
        yield "## Report card\n\n| | | |\n|---|---|---|\n" + "\n".join(rows)

    def _policy(self) -> Iterable[str]:
        facts = self.facts
        yield f"# {_plain(self.name)}: a policy from preferences"
        if self.best:
            yield "This is the best policy by the newest reward. The numbers below are of the last one."
        yield f"{headline(facts)} {verdict(facts)}".strip()
        if self.record.card is not None:
            yield f"Its reward model: {card_headline(self.record.card)}"
        (before, after, _), (fluent, now) = facts.gold, facts.fluency
        rows = [
            ("gold", show_number(before, after), show_number(after, before), after),
            ("fluency, share of the start's", show_share(fluent), show_share(now), now),
            ("KL to the start, nats", "0", show_number(facts.kl), facts.kl),
        ]
        lines = [f"| {name} | {first} | {last} |" for name, first, last, known in rows if known is not None]
        if lines:
            yield "| | before | after |\n|---|---|---|\n" + "\n".join(lines)

    def _made(self) -> str:
        """The settings, less what concerns who was asked where."""
        goal = _plain(visible(self.settings.get("goal"), 200))
        parts = (
            ("task", "reward", "fitting") if self.form in JUDGES else ("task", "reward", "fitting", "learner", "loop")
        )
        shown = {name: self.settings[name] for name in parts if name in self.settings}
        asker = visible(mapping(self.settings.get("labeler")).get("kind"), 100)
        text = visible(yaml.safe_dump(shown, sort_keys=False, allow_unicode=True), MAX_CONFIG)
        lines = "\n".join(f"    {line}" for line in text.splitlines())
        question = f'The question was "{goal}" ' if goal else "Judgements came "
        by = f"(labeler: {asker}). The settings, of prefrl {version('prefrl')}:"
        return f"## How it was made\n\n{question}{by}\n\n{lines}"

    def _use(self) -> str:
        _, language, lines = USES[self.form]
        to = json.dumps(self.name, ensure_ascii=False) if language == "python" else shlex.quote(self.name)
        return f"## Use\n\n```{language}\n{lines.format(to=to)}\n```"


def _plain(text: str) -> str:
    """A text as it stands on one line, whatever is in it."""
    return re.sub(r"([|<`*_\[\]\\])", r"\\\1", " ".join(text.split()))
