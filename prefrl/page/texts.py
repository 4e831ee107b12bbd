"""What people read before they answer: the guideline, and what they agree to. Who has agreed is kept as a setting."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from prefrl.page.access import Event
from prefrl.storage.log import row

TEXT = "consent"
AGREED = "consent:"
"""Before the name of who has agreed, to which version."""


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


def agreements(kept: Mapping[str, Any]) -> dict[str, str]:
    """Name -> version, of a store's settings."""
    return {key.removeprefix(AGREED): version for key, version in kept.items() if key.startswith(AGREED)}


def text_event(text: str) -> Event:
    """From now on people must agree to this."""
    return row(f"project:{uuid.uuid4().hex}", "project", body={TEXT: text})


def agreement_event(name: str, version: str) -> Event:
    """Somebody agrees; the event says when."""
    return row(f"project:{uuid.uuid4().hex}", "project", actor=name, body={AGREED + name: version})
