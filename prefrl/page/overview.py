"""What admins are sent: what the dashboard shows, and links."""

from __future__ import annotations

from typing import Literal

from prefrl.page.api import AgreementRow, AnnotatorRow, Guideline, Page, Plain


class Link(Plain):
    link: str


class Health(Plain):
    store: str
    """ "ok", "read-only" or what is wrong."""
    sequence: int
    queue: int
    """Submissions waiting to be written."""
    clips: dict[str, int]
    """drawn, failed, cached, waiting."""
    uptime_seconds: float


class Overview(Plain):
    page: Page
    asked: int
    answered: int
    open: int
    leased: int
    skipped: int
    incomparable: int
    overlap: int
    guideline: Guideline
    throughput: list[tuple[str, int]]
    """(start of the minute or hour, UTC ISO; answers in it), oldest first."""
    throughput_unit: Literal["minute", "hour"]
    annotators: list[AnnotatorRow]
    agreement: AgreementRow
    health: Health
    flags: list[dict[str, str]]
    """Reported problems: at, actor, query, text; newest first, 50 at most."""
    exports: list[str]
    """Names that /api/admin/export/{name} knows."""
