"""What goes over the wire between the labelling page and the server: strict in, plain out."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, model_validator

from prefrl.stats.estimates import Estimate
from prefrl.types import Json

Id: TypeAlias = Annotated[str, Field(pattern="^[0-9a-f]{32}$")]
"""A client-made or server-made 128-bit id."""
Milliseconds: TypeAlias = Annotated[float, Field(ge=0, le=1e9)]
COMMENT = 4000
"""Characters of a comment at most."""
HISTORY = 50
"""How many of one's last answers can be looked at and taken back."""
AHEAD = 6
"""Questions that one person may hold at once: the one shown, and those fetched ahead."""


class Body(BaseModel):
    """What a client sends: typed as JSON is, nothing extra, no NaN."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)


class Plain(BaseModel):
    """What the server sends."""

    model_config = ConfigDict(frozen=True)


# --- sent by the page ----------------------------------------------------------------------------------------------


class Login(Body):
    """An invite link's token, from the URL's fragment."""

    token: str = Field(min_length=1, max_length=200)


class Want(Body):
    want: int = Field(3, ge=1, le=AHEAD)


class Heartbeat(Body):
    assignments: list[Id] = Field(max_length=AHEAD)


class Timings(Body):
    """How a person came to an answer; what is not known is left at its default."""

    visible_ms: Milliseconds = 0.0
    """While the question was on a visible tab."""
    decision_ms: Milliseconds = 0.0
    """From when it could be answered to the answer."""
    hidden_ms: Milliseconds = 0.0
    replays: int = Field(0, ge=0, le=10_000)
    speed: float = Field(1.0, ge=0.1, le=10)
    watched: list[Annotated[float, Field(ge=0, le=1)]] = Field(default_factory=list, max_length=8)
    """The share of each clip that was seen, slot by slot."""


Outcome: TypeAlias = Literal["first", "second", "tie", "incomparable", "skip", "ranking", "shown"]
Ask: TypeAlias = Literal["judge", "action", "rewrite"]
"""What people do: judge candidates, show what to do at each step of a clip, or write a response anew."""
STEPS, DIMENSIONS = 2000, 64
"""Of a shown behaviour at most."""
Row: TypeAlias = Annotated[list[float], Field(min_length=1, max_length=DIMENSIONS)]


class Shown(Body):
    """What a person shows in the place of what the policy did: one of the two."""

    actions: Annotated[list[Row | None], Field(min_length=1, max_length=STEPS)] | None = None
    """At each step a number for each dimension, or the number of a discrete action alone; null where the policy's own
    action is right."""
    text: str | None = Field(None, max_length=50_000)

    @model_validator(mode="after")
    def _one(self) -> Shown:
        if (self.actions is None) == (self.text is None):
            raise ValueError("expected actions or a text, and not both")
        return self


class Draft(Body):
    """Something that may be sent soon."""

    assignment_id: Id
    shown: Shown


class Answer(Body):
    """One answer, in the order of the slots as they were shown; the server turns it into the query's own order."""

    submission_id: Id
    assignment_id: Id
    outcome: Outcome
    """`first` and `second` name slots; `ranking` goes with more than two candidates, `shown` with a single one."""
    strength: Literal["slight", "clear", "much"] | None = None
    """With `first` and `second` only."""
    ranking: list[Annotated[int, Field(ge=0, le=7)]] | None = Field(None, min_length=2, max_length=8)
    """A rank for each slot, 0 is best, equal ranks are ties; with `ranking` only."""
    shown: Shown | None = None
    """With `shown` only."""
    touched: bool = True
    """False where a ranking was sent as it was presented."""
    flags: list[Annotated[str, Field(max_length=40)]] = Field(default_factory=list, max_length=8)
    comment: str = Field("", max_length=COMMENT)
    timings: Timings = Timings()
    input: Literal["key", "mouse", "touch"] = "key"
    ui_version: str = Field("", max_length=40)
    guideline: str = Field("", pattern="^[0-9a-f]{0,64}$")
    """Version of the guideline that this person has read last; "" where it is that of the assignment."""

    @model_validator(mode="after")
    def _consistent(self) -> Answer:
        if (self.ranking is not None) != (self.outcome == "ranking"):
            raise ValueError("ranking goes with the outcome 'ranking', and only with it")
        if (self.shown is not None) != (self.outcome == "shown"):
            raise ValueError("shown goes with the outcome 'shown', and only with it")
        if self.strength is not None and self.outcome not in ("first", "second"):
            raise ValueError("strength goes with the outcomes 'first' and 'second' only")
        return self


class Undo(Body):
    submission_id: Id
    assignment_id: Id


class Flag(Body):
    """A problem that a person reports."""

    submission_id: Id
    assignment_id: Id | None = None
    text: str = Field(min_length=1, max_length=COMMENT)


class Agreement(Body):
    version: str = Field(max_length=40)


class NewAnnotator(Body):
    name: str = Field(min_length=1, max_length=80)
    role: Literal["annotator", "admin", "trainer"] = "annotator"


class Project(Body):
    overlap: int = Field(ge=1, le=20)


class NewGuideline(Body):
    text: str = Field(max_length=20_000)


# --- sent by the server --------------------------------------------------------------------------------------------


class Actions(Plain):
    """What an agent can do at a step."""

    discrete: bool
    names: list[str]
    """Of discrete actions, or of the dimensions of others; "" for one without a name."""
    low: list[float | None] = []
    """The least value of each dimension, null where there is none; nothing for discrete actions."""
    high: list[float | None] = []


class Page(Plain):
    """How the page behaves; the same for everybody in a project."""

    title: str
    """What is judged, "Hopper-v5" say."""
    question: str
    """What is asked, in one sentence."""
    kind: str
    strength: bool
    """Whether a preference can be slight, clear or much."""
    markdown: bool
    """Whether Markdown and the turns of a conversation are drawn, until a person asks for what was written."""
    minimum_watched: float
    """The share of each clip that must be seen before an answer."""
    break_minutes: float
    """After how long at work the page suggests a break; 0 for never."""
    ui_version: str
    ask: Ask = "judge"
    actions: Actions | None = None
    """For people who show actions."""


class Progress(Plain):
    mine: int
    """Answers of this person that stand, skips among them."""
    answered: int
    """Questions with all the answers they need."""
    asked: int
    waiting: int
    """Questions that this person could still be given."""


class Me(Plain):
    store: str
    """Which store this is, of all that a browser may know."""
    name: str
    role: Literal["annotator", "admin", "trainer"]
    page: Page
    progress: Progress
    guideline: str
    """Version of the guideline; "" where there is none."""
    consent: str
    """Version of what this person must agree to first; "" where there is nothing, or no more."""


class State(Plain):
    seq: int
    progress: Progress
    guideline: str
    paused: bool
    read_only: bool
    """The disk is full: answers stay in the browser until there is room."""
    finished: bool
    """The run needs no more answers."""
    consent: str
    """As in `Me`."""


class Item(Plain):
    """A candidate as it is shown; nothing in it says where it came from."""

    slot: int
    media: list[str] = []
    """Addresses of the clip, best format first; empty for text."""
    steps: int = 0
    fps: float = 0.0
    text: str | None = None
    actions: list[list[float]] | None = None
    """What the policy did at each step, as in `Shown`: for people who show what it should have done."""


class Assignment(Plain):
    assignment_id: Id
    query_id: str
    kind: str
    prompt: str | None = None
    items: list[Item]
    """In the order of the slots: slot 0 stands left, or on top."""
    guideline: str
    lease_seconds: float


class Assignments(Plain):
    assignments: list[Assignment]
    reason: Literal["waiting", "done", "paused", "read-only", "consent"] | None = None
    """Why there are none: more may come, none will, this person is paused, nothing can be stored, or this person must
    agree to something first."""


class Receipt(Plain):
    seq: int
    duplicate: bool


class Measured(Plain):
    """What a draft comes to."""

    length: int
    longest: int
    """Tokens of a text, its end counted, and how many it may have; steps of a clip."""
    fault: str
    """Why it would be refused, one sentence; "" where it would not."""


class Undone(Plain):
    assignment: Assignment
    answer: Json
    """The answer that was taken back, as it was sent: outcome, strength, ranking, shown, comment, flags."""


class Entry(Plain):
    """One of a person's last answers."""

    assignment: Assignment
    answer: Json
    at: str
    """UTC, ISO 8601."""


class History(Plain):
    entries: list[Entry]


class Guideline(Plain):
    version: str
    text: str


class Consent(Plain):
    version: str
    text: str


class Failure(Plain):
    error: str
    """One sentence for people."""


# --- for admins ----------------------------------------------------------------------------------------------------


class AnnotatorRow(Plain):
    name: str
    role: str
    state: Literal["active", "paused", "revoked"]
    answers: int
    skips: int
    median_seconds: float | None
    """Median time to a decision."""
    per_hour: float | None
    left: Estimate
    """P(the left, or first shown, one is preferred), of decided pairs; Wilson's interval."""
    ties: Estimate
    checks: Estimate
    """Share of check questions answered as expected."""
    repeats: Estimate
    """Share of repeated questions answered alike with sides swapped."""
    agreement: Estimate
    """Share of pairs on which this person agrees with the others who judged them."""
    too_fast: int
    """Answers in less than half a clip's length."""
    last_seen: str | None
    concerns: list[str] = []
    """What an admin should look at, in words: one side always, checks missed, answers too fast."""


class AgreementRow(Plain):
    """Agreement over everybody."""

    raw: Estimate
    cohen: Estimate
    """Mean over pairs of annotators with common queries."""
    fleiss: Estimate
    krippendorff: Estimate
    intransitive: Estimate
    """Share of fully compared triads that go round in a circle."""


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
