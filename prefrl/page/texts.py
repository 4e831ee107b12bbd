"""What people read before they answer: the guideline, and what they agree to. Who has agreed is kept as a setting."""

from __future__ import annotations

import hashlib
import uuid
from dataclasses import dataclass, field
from typing import Any

from prefrl.kinds import Kind
from prefrl.page import api
from prefrl.page.access import Event
from prefrl.storage.log import row
from prefrl.types import Fields

TEXT = "consent"
OFFERED = "guideline:offered"
"""The version of the guideline that we ship, where that is the one that was written down: it gives way to any other."""
AGREED = "consent:"
"""Before the name of who has agreed, to which version."""


ANSWERS: dict[api.Ask, tuple[tuple[str, str], ...]] = {
    "judge": (
        (
            "One is better",
            "choose it, and say by how much if you are asked: *slightly* for a small difference, *much* for one "
            "that is plain at first sight.",
        ),
        ("Several at once", "put the best one first. Those that are equally good can share a place."),
        ("Tie", "you compared them, and they are equally good or equally bad."),
        ("Can't compare", "there is no sensible answer to the question, or no telling."),
    ),
    "action": (
        ("Set an action", "it holds from this step on, until the next step that you set."),
        ("As the policy", "what was done is right, from this step on."),
        ("Send", "once every step has an answer. One that you set at the first step answers them all."),
        ("Can't tell", "there is no telling what should be done here. Nothing is learned from it."),
    ),
    "rewrite": (
        ("Change the response", "as much or as little as it takes. What you send is what the model learns to write."),
        ("Fine as it is", "there is nothing to change. Nothing is learned from it."),
    ),
}
SKIP = ("Skip", "something is broken, or you would rather not answer. Somebody else gets the question.")
HINTS: dict[api.Ask, tuple[str, ...]] = {
    "action": (
        "Watch the clip first: it shows what the policy did, and beside it stands what it did at each step.",
        "Then go through it step by step. Say what you would do in the situation that you see, even where you would "
        "not have come to it: what is shown next follows from what the policy did, not from your answer.",
    ),
    "rewrite": (
        "Read the prompt, then the response to its end.",
        "Your text answers the same prompt, and goes on right where the prompt ends. It may not be much longer than "
        "what the model can write; the page says how much room there is.",
    ),
}
ADVICE = (
    "Do not spend long on one question: your own honest impression is worth more than a guess at what "
    "others would say. Your last answers can be taken back."
)


def question_of(ask: api.Ask, kind: Kind[Any]) -> str:
    """What is asked where nobody said it, in one sentence."""
    ours = {"action": "What should be done at each step?", "rewrite": "How should this response read?"}
    return ours.get(ask, kind.question)


def default_guideline(question: str, kind: Kind[Any], ask: api.Ask = "judge") -> str:
    """The guideline of a project that has none of its own, as Markdown: what is asked, how to look, how to answer."""
    look = [f"- {hint}" for hint in HINTS.get(ask, kind.hints)]
    answers = [f"- **{name}:** {meaning}" for name, meaning in (*ANSWERS[ask], SKIP)]
    aim = [f"**{question}**", "Only this counts, whatever else may be better or worse."]
    parts = [*aim, *["## How to look", "\n".join(look)] * bool(look), "## How to answer", "\n".join(answers), ADVICE]
    return "\n\n".join(parts)


def version_of(text: str) -> str:
    """A text's version: the beginning of its sha256; "" for none."""
    return hashlib.sha256(text.encode()).hexdigest()[:12] if text else ""


def guideline_event(text: str, actor: str) -> Event:
    return row(f"guideline:{uuid.uuid4().hex}", "guideline", "", actor, {"text": text})


@dataclass
class Consent:
    """A text with its version, and which version each person has agreed to. "" for a text that nobody is asked for."""

    text: str = ""
    version: str = ""
    agreed: dict[str, str] = field(default_factory=dict)

    def owed(self, name: str) -> str:
        """The version that somebody must still agree to, or ""."""
        return "" if self.agreed.get(name) == self.version else self.version


def agreements(kept: Fields) -> dict[str, str]:
    """Name -> version, of a store's settings."""
    return {key.removeprefix(AGREED): version for key, version in kept.items() if key.startswith(AGREED)}


def offered_event(version: str) -> Event:
    """The guideline of this version is ours; "" where it is not."""
    return row(f"project:{uuid.uuid4().hex}", "project", body={OFFERED: version})


def text_event(text: str) -> Event:
    """From now on people must agree to this."""
    return row(f"project:{uuid.uuid4().hex}", "project", body={TEXT: text})


def agreement_event(name: str, version: str) -> Event:
    """Somebody agrees; the event says when."""
    return row(f"project:{uuid.uuid4().hex}", "project", actor=name, body={AGREED + name: version})
