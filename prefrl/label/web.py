"""People in a browser: a page with one question after the other, served from the process that owns the store."""

from __future__ import annotations

import copy
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, cast

import numpy as np
from pydantic import Field, field_validator, model_validator
from rich.console import Console

from prefrl.components import ConfigError, Settings, missing
from prefrl.kinds import named
from prefrl.label.checks import pick_checks
from prefrl.page import api, records, static_files
from prefrl.page.clips.encode import INSTALL, formats
from prefrl.page.clips.queue import ClipSettings
from prefrl.page.questions import Policy, Terms
from prefrl.page.shown import ActionShowing, Showing, TextShowing
from prefrl.page.texts import default_guideline, question_of
from prefrl.protocols import ControlTask, DrawnTask, NamesActions, Store, Task, control, text
from prefrl.types import C

if TYPE_CHECKING:  # a run without people loads no web server
    from prefrl.page.site import Site

TELL_SECONDS = 30.0
"""How often it is told how far people are."""
SHOWING_SECONDS = 600.0
"""After how long without a sign of life a question goes to somebody else, where people show what to do."""


class Strengths(Settings):
    """How likely the preferred one is taken to be better."""

    slight: float = Field(0.73, ge=0.5, le=1)
    """Of "slightly better"."""
    clear: float = Field(0.88, ge=0.5, le=1)
    """Of "clearly better"."""
    much: float = Field(0.95, ge=0.5, le=1)
    """Of "much better"."""


class WebSettings(Settings):
    """Ask people in their browsers, while the run goes on."""

    kind: Literal["web"] = "web"
    ask: api.Ask = "judge"
    """What people do: judge candidates; say what should have been done at each step of a clip (action, for control); or
    write a response anew (rewrite, for text). What they show is a demonstration: it takes select.candidates=1, and has
    no check questions and no repeats."""
    name: str = "me"
    """Whose link is printed; this person is an admin, and can invite others on the page."""
    host: str = "127.0.0.1"
    """The address to listen on; 0.0.0.0 for all of this machine's."""
    port: int = Field(8900, ge=0, le=65535)
    """0 takes any free one."""
    allowed_hosts: tuple[str, ...] = ()
    """Other names under which people reach the page, "lab.example.org" say."""
    tls_cert: Path | None = None
    """The certificate, PEM, for https."""
    tls_key: Path | None = None
    """Its key."""
    overlap: int = Field(1, ge=1, le=20)
    """How many different people each question goes to; an admin can change it on the page."""
    when_empty: Literal["wait", "continue"] = "wait"
    """Each round: wait until people have answered `enough`, or go on with what there is after the very first."""
    enough: float = Field(0.5, gt=0, le=1)
    """The share of all questions asked so far that must be judged before a round goes on."""
    lease_seconds: float | None = Field(None, gt=0)
    """After how long without a sign of life a question goes to somebody else (120 for clips, 600 for texts and for what
    people show)."""
    strength: bool = True
    """Whether a preference can be slight, clear or much."""
    strengths: Strengths = Strengths()
    """What these mean as preferences; without a strength the preferred one is taken to be better for certain."""
    guideline: str | None = None
    """How to judge, as Markdown, shown before the first question; an admin can change it on the page. Left out, a short
    one that fits the kind of candidate; "" for none."""
    consent: str = ""
    """What people must agree to before their first question; who agreed to which version, and when, is kept."""
    question: str = ""
    """What is asked, in one sentence; where it is left out the goal of the run, if people judge, or one of our own."""
    check_share: float = Field(0.05, ge=0, le=0.5)
    """The share of questions with a clear answer, to find out whether a person looks. Nothing is learned from them."""
    check_warn: float = Field(0.8, ge=0, le=1)
    """Admins are told of who answers fewer checks than this share as expected (the 95 % interval's upper end)."""
    check_pause: float = Field(0.0, ge=0, le=1)
    """Who answers fewer than this share as expected, by the same interval, is paused until an admin has them go on."""
    repeat_share: float = Field(0.05, ge=0, le=0.5)
    """The share of questions that are asked of the same person again, with the sides turned round."""
    minimum_watched: float = Field(0.0, ge=0, le=1)
    """The share of each clip that must be seen before an answer."""
    markdown: bool = True
    """Whether Markdown and the turns of a conversation are drawn; each person can still ask for what was written."""
    break_minutes: float = Field(30.0, ge=0)
    """After how long at work a break is suggested; 0 for never."""
    stay_open: bool = False
    """Whether a fixed pool is served on when all is answered, for a trainer elsewhere that asks more."""
    requests_per_second: float = Field(10.0, gt=0)
    """How many requests one person may make."""
    seed: int = Field(0, ge=0)
    """Of the order of sides, and of when checks and repeats come."""
    clips: ClipSettings = ClipSettings()
    """How clips are drawn and kept."""

    @field_validator("name")
    @classmethod
    def _can_be_a_name(cls, name: str) -> str:
        from prefrl.page.access import check_name

        return check_name(name)

    @field_validator("guideline", "consent", "question")
    @classmethod
    def _can_be_sent(cls, text: str | None) -> str | None:
        if any("\ud800" <= c <= "\udfff" for c in text or ""):
            raise ValueError("the text holds half a surrogate pair: expected UTF-8")
        return text

    @model_validator(mode="after")
    def _whole(self) -> WebSettings:
        if (self.tls_cert is None) != (self.tls_key is None):
            raise ValueError("tls_cert and tls_key go together: give both or none")
        if self.check_share + self.repeat_share >= 1:
            raise ValueError("check_share and repeat_share together must leave room for questions")
        return self

    def lasting(self) -> Self:
        """Where the page is served may change, when a port is taken say; what it explains and how it looks as well."""
        free = ("host", "port", "allowed_hosts", "tls_cert", "tls_key", "markdown", "guideline")
        return self.model_copy(update={name: type(self).model_fields[name].default for name in free})

    def asks_people(self) -> bool:
        return True

    def asking(self, goal: str) -> Self:
        # A goal asks which one is better, and people who show what to do see only one.
        return self if self.question or self.ask != "judge" else self.model_copy(update={"question": goal})

    def build(self, task: Task) -> WebLabeler:
        return WebLabeler(self, task, showing(self.ask, task))


@dataclass
class WebLabeler:
    """A `prefrl.protocols.Attended`: `open` starts the page, `answer` waits for people, `close` ends the page.

    While it is not open nobody can answer, and `answer` returns at once.
    """

    settings: WebSettings
    task: Task
    shows: Showing | None = None
    """How what people show becomes a behaviour; None where they judge."""
    console: Console = field(default_factory=Console)
    fixed: bool = False
    """No more questions will come, and all are waited for."""
    _site: Site | None = None
    _warm: bool = False
    """Whether the first clips were drawn, or tried."""
    _checked: int = 0
    """How many queries there were when check questions were last chosen."""

    @property
    def name(self) -> str:
        return self.settings.name

    @property
    def demonstrates(self) -> bool:
        return self.shows is not None

    @property
    def corrects(self) -> bool:
        return True

    def open(self, store: Any, fixed: bool = False) -> list[str]:
        """Start the page; returns what people should know, the link first. Raises `ConfigError`."""
        self.fixed = fixed
        self._check_asked(store)
        try:
            from prefrl.page.site import Address, open_site
        except ModuleNotFoundError as error:
            raise ConfigError(f"labeler kind 'web': {missing(error)}") from error
        settings = self.settings
        place = Address(settings.host, settings.port, settings.allowed_hosts, settings.tls_cert, settings.tls_key)
        clips = settings.clips if named(self.task.kind).shows == "clip" else None
        terms = terms_of(settings, self.task, fixed, self.shows)
        self._site = open_site(store, terms, place, settings.name, clips)
        try:
            late = self._draw_first(self._site)
        except BaseException:  # Ctrl-C while it waits
            self.close()
            raise
        return [*self._site.notes, *late]

    def close(self) -> None:
        """End the page. What was acknowledged is in the store."""
        if self._site is not None:
            self._site.close()
            self._site = None

    def answer(self, store: Store[C], rng: np.random.Generator) -> None:
        """Wait until people have answered enough of what was asked; all of it, where no more will be asked."""
        if self._site is None:
            return
        self._file_checks(self._site, store, rng)
        for note in self._draw_first(self._site):
            self._print(note)
        self._site.service.refresh()  # after the drawing: until then nobody is given the new questions
        self._wait(self._site)
        while self.fixed and not self._site.say_goodbye():
            self._wait(self._site)

    def _check_asked(self, store: Any) -> None:
        """Raise `ConfigError` where the store asks what these people are not asked for."""
        with store.log.reading() as connection:
            sizes = records.sizes(connection)
        wrong = [size for size in sizes if (size == 1) != self.demonstrates]
        if wrong:
            fits = "of one candidate" if self.demonstrates else "of two or more candidates"
            other = "labeler.ask=judge" if self.demonstrates else "labeler.ask=action (or rewrite, for texts)"
            raise ConfigError(
                f"labeler.ask={self.settings.ask} asks about queries {fits}, and here are open ones of {wrong[0]}: "
                f"set {other}"
            )

    def _draw_first(self, site: Site) -> list[str]:
        """Have the clips of the first questions drawn before anybody looks; what people should know, if they are not.

        Only the first ones are waited for: then the process that draws is there, and a clip takes a moment.
        """
        limit, first = self.settings.clips.ahead_seconds, site.undrawn()
        if site.clips is None or not limit or not first:
            return []
        if self._warm:
            for one in first:
                site.clips.want(one, soon=True)
            return []
        self._warm = True
        clips = "the first clip" if len(first) == 1 else f"the first {len(first)} clips"
        self._print(f"drawing {clips}, for {limit:g} seconds at most")
        trouble = site.clips.draw(first, limit)
        return [f"the first clips are not there yet ({trouble}): the page goes on trying"] if trouble else []

    def _wait(self, site: Site) -> None:
        """Until nothing is missing; for ever, where a pool stays open."""
        told, stay = -math.inf, self.fixed and self.settings.stay_open
        while (left := site.left() if self.fixed else self._missing(site)) > 0 or stay:
            if left > 0 and time.monotonic() - told > TELL_SECONDS:
                told = time.monotonic()
                self._tell(site, left)
            site.wait(1.0)

    def _missing(self, site: Site) -> int:
        """How many more questions must be judged before a round goes on; what everybody skipped is let go."""
        asked, judged, stuck = site.judged()
        share = self.settings.enough if self.settings.when_empty == "wait" else 0.0
        # 0.07 * 100 is a little more than 7 in floating point, and would be rounded up to 8.
        wanted = max(1, math.ceil(share * (asked - stuck) - 1e-9))
        return min(asked - stuck, wanted) - judged

    def _tell(self, site: Site, left: int) -> None:
        text = f"waiting for answers to {left} more question{'s' * (left != 1)} at {site.address}"
        self._print(text + site.people_missing())

    def _print(self, text: str) -> None:
        self.console.print(text, soft_wrap=True, markup=False)

    def _file_checks(self, site: Site, store: Store[C], rng: np.random.Generator) -> None:
        """Choose check questions among the candidates of what is open, as many as will be given."""
        asked = store.counts()["asked"]
        if self.demonstrates or not self.settings.check_share or asked == self._checked:
            return
        # Noted, so that a wait without new questions files no second set of checks.
        self._checked, open_ids = asked, site.open_queries()
        some = rng.permutation(len(open_ids))[: named(self.task.kind).looked_at]
        looked_at = [cast(Any, store).query(open_ids[i]) for i in sorted(some.tolist())]
        count = math.ceil(self.settings.check_share * len(open_ids))
        chosen = pick_checks(store, looked_at, count, rng)
        if chosen.queries:
            cast(Any, store).ask(chosen.queries, purpose="check", expected=chosen.expected)


def showing(ask: api.Ask, task: Task) -> Showing | None:
    """How what people show in a task becomes a behaviour; None where they judge. Raises `ConfigError`."""
    if ask == "action":
        if formats()[0] == "webp":
            raise ConfigError(f"labeler.ask=action: people go frame by frame, which takes videos: {INSTALL}")
        found = control(task, "labeler.ask=action asks for actions in clips")
        return ActionShowing(found.action_size, found.action_bounds)
    if ask == "rewrite":
        written = text(task, "labeler.ask=rewrite asks for texts")
        tokenizer = copy.deepcopy(written.tokenizer)  # the learner pads with its own, at the same time

        def encode(said: str) -> tuple[int, ...]:
            return (*tokenizer.encode(said, add_special_tokens=False), written.ends[0])

        return TextShowing(written.response_tokens, encode)
    return None


def terms_of(settings: WebSettings, task: Task, fixed: bool, shows: Showing | None = None) -> Terms:
    """What a project asks and how, from its settings. `fixed`: no more will be asked than the store holds."""
    kind = named(task.kind)
    clips, question = kind.shows == "clip", settings.question or question_of(settings.ask, kind)
    page = api.Page(
        title=task.name,
        question=question,
        kind=kind.name,
        strength=settings.strength,
        markdown=settings.markdown,
        minimum_watched=settings.minimum_watched if clips else 0.0,
        break_minutes=settings.break_minutes,
        ui_version=static_files.ui_version(static_files.static_files()),
        ask=settings.ask,
        actions=_actions(cast(ControlTask, task)) if settings.ask == "action" else None,
    )
    lease = settings.lease_seconds or (kind.lease_seconds if shows is None else SHOWING_SECONDS)
    shares = (settings.check_share, settings.repeat_share) if shows is None else (0.0, 0.0)
    policy = Policy(settings.overlap, lease, *shares, settings.seed)
    shipped = default_guideline(question, kind, settings.ask)
    return Terms(
        page=page,
        policy=policy,
        strengths=dict(settings.strengths),
        guideline=shipped if settings.guideline is None else settings.guideline,
        offered=settings.guideline is None,
        consent=settings.consent,
        fps=cast(DrawnTask[Any], task).fps if clips else 0.0,
        shows=shows,
        fixed=fixed and not settings.stay_open,
        check_warn=settings.check_warn,
        check_pause=settings.check_pause,
        rate=settings.requests_per_second,
    )


def _actions(task: ControlTask) -> api.Actions:
    """What people can say that the agent should do."""
    known = list(task.action_names) if isinstance(task, NamesActions) else []
    names = known or [""] * task.action_size
    if task.action_bounds is None:
        return api.Actions(discrete=True, names=names)
    low, high = ([float(x) if math.isfinite(x) else None for x in bound] for bound in task.action_bounds)
    return api.Actions(discrete=False, names=names, low=low, high=high)
