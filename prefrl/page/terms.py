"""What a project asks, and how; and which settings do not hold, since the store knows others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from prefrl.page import api
from prefrl.page.questions import Policy


@dataclass(frozen=True)
class Terms:
    """What a project asks, and how."""

    page: api.Page
    policy: Policy
    strengths: dict[str, float]
    """slight, clear and much as preferences."""
    guideline: str = ""
    """Its text at the beginning."""
    consent: str = ""
    """What people agree to before their first question; "" for nothing."""
    fps: float = 0.0
    fixed: bool = False
    """No more questions will come: who has answered all is done."""
    check_warn: float = 0.8
    """Admins are told of who surely answers fewer check questions than this share as expected."""
    check_pause: float = 0.0
    """Who surely answers fewer than this share is paused, until an admin has them go on."""
    rate: float = 10.0
    """Requests a second that one person may make; three times as many at once."""


def ignored(terms: Terms, overlap: int, guideline: api.Guideline) -> Iterator[str]:
    """Which settings do not hold, since the store knows others: `overlap` and `guideline` do."""
    if overlap != terms.policy.overlap:
        yield (
            f"labeler.overlap={terms.policy.overlap} is not used: an admin has set {overlap} on the page, and can "
            "change it there"
        )
    if terms.guideline not in ("", guideline.text):
        yield (
            f"labeler.guideline is not used: the store has one already (version {guideline.version}), which an admin "
            "can change on the page"
        )
