"""The kinds of candidate: one row for each says how it is named, stored, measured, cut, shown and checked.

Code that must know how a candidate of any kind is written or shown asks its row. A fourth kind is a row more: here, or
in an installed package, through the entry-point group `prefrl.kinds`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import entry_points
from typing import Any, Generic, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from prefrl.components import suggest
from prefrl.types import LARGEST, C, Candidate, Fields, Json, Picture, Response, Segment, is_whole

Arrays: TypeAlias = dict[str, npt.NDArray[Any]]


class Shown(NamedTuple):
    """The part of a candidate that people see, as its event describes it."""

    prompt: str | None = None
    """What stands above all candidates of a query."""
    text: str | None = None
    """None where a clip is shown instead."""
    steps: int = 0
    """Of a clip."""


@dataclass(frozen=True, eq=False)
class Kind(Generic[C]):
    """One kind of candidate. Where a field has a default, it is what most kinds need."""

    name: str
    """The `kind` of its tasks, and in `summary.json`."""
    candidate: type[C]
    noun: str
    """What one is called, also in the log; more than one with an s behind it."""

    # --- stored ---
    describe: Callable[[C], Json]
    """Without its arrays and its gold, as JSON holds it."""
    load: Callable[[Fields, Callable[[], Arrays]], C]
    """From its description, and a function that reads its arrays."""
    arrays: Callable[[C], Arrays] = lambda _: {}
    """What is kept in a file of its own; nothing where the description says all."""
    fault: Callable[[C], str] = lambda _: ""
    """What cannot be believed of one from elsewhere, as the end of a sentence about it; "" where all can."""
    plain: Callable[[C], C] = lambda candidate: candidate
    """What is left after a way through a file of rows, which holds no tokens and no simulator states."""
    tokens: Callable[[C], bool] = lambda _: False
    """Whether one carries tokens, which a file of texts has no room for."""
    misfit: Callable[[C, Any], str] = lambda _, __: ""
    """How one is not as the behaviours of a task are; "" where it is."""

    # --- measured ---
    length: Callable[[C], int] = lambda _: 1
    unit: Callable[[Sequence[C]], str] = lambda _: "candidates"
    """What the lengths of some count."""
    words: Callable[[C], int] = lambda _: 0
    """Characters that a judge may take for merit; 0 where there are none to see."""
    lengthy: bool = False
    """Whether a judge can prefer one for its length."""
    stepwise: bool = False
    """Whether there is a reward for each step, so that one can be discounted, and windows can be cropped."""
    pipelines: tuple[str, str] = ("reinforcement-learning", "reinforcement-learning")
    """What the Hub calls the job of a reward model, and of a policy."""
    drifts: bool = False
    """Whether its policies start from a model that they may drift from: how far, and whether they stay fluent."""
    cluster: Callable[[C], str] = lambda candidate: candidate.context
    """Those of one cluster are not independent, and are resampled together."""
    origin: Callable[[C], str] = lambda candidate: candidate.id
    """Two of one origin are too much alike to find out whether somebody looks."""
    overlap: Callable[[C, C], bool] = lambda _, __: False
    """Whether two share a part, which says nothing when they are compared."""
    half: Callable[[C], C] = lambda candidate: candidate
    """The first half; all of one that cannot be cut."""

    # --- shown ---
    shows: Literal["clip", "text"] = "text"
    """A clip is drawn by the task, and text is there already."""
    still: bool = False
    """Whether its clips are single pictures, which need no player."""
    shown: Callable[[Fields], Shown] = lambda _: Shown()
    """From its description."""
    question: str = "Which is better?"
    hints: tuple[str, ...] = ()
    """How to look at some, for people; a sentence or two each."""
    lease_seconds: float = 120.0
    """After how long without a sign of life a question goes to somebody else."""
    looked_at: int = 250
    """Open queries whose candidates check questions are made of: large ones stay in memory."""
    exports: Mapping[str, str] = field(default_factory=lambda: {"bundle": ""})
    """The forms of `prefrl export` that a page offers, and how their files end; "" for folders."""
    shown_file: str = ""
    """How a file of what people showed ends; empty where nobody is asked to show."""
    start: str = "start"
    """What a behaviour begins from."""
    behaviour: str = "candidate"
    """What a policy is measured on."""
    step: str = "step"
    """What a run spends, in a word."""
    spent: str = "step"
    """What a run spends, in full."""


def _are_text(*values: object) -> bool:
    """From elsewhere anything may come, whatever the types promise."""
    return all(isinstance(value, str) for value in values)


# --- segments -------------------------------------------------------------------------------------------------------


def _describe_segment(one: Segment) -> Json:
    place = {"context": one.context} if one.context else {}  # as it was before there were any
    return {"episode": one.episode, "start": one.start, "steps": len(one)} | place


def _load_segment(body: Fields, read: Callable[[], Arrays]) -> Segment:
    x = read()
    return Segment(
        x["observations"],
        x["actions"],
        body["episode"],
        body["start"],
        x.get("states"),
        context=body.get("context", ""),
    )


def _segment_arrays(one: Segment) -> Arrays:
    arrays = {"observations": one.observations, "actions": one.actions, "states": one.states}
    return {name: array for name, array in arrays.items() if array is not None}


def _segment_fault(one: Segment) -> str:
    if not _are_text(one.episode):
        return f"is not described as it is: its episode is {one.episode!r:.40}; expected text"
    if not _are_text(one.context):
        return f"is not described as it is: its context is {one.context!r:.40}; expected text"
    if not is_whole(one.start, LARGEST):
        return f"starts at step {one.start!r:.40}; expected a number from 0 on"
    for name, array in (("observations", one.observations), ("actions", one.actions)):
        if array.dtype.kind != "f" or not np.isfinite(array).all():
            return f"has {name} that are not all finite floats"
    return ""


def _segment_misfit(one: Segment, task: Any) -> str:
    sizes = (one.observations.shape[1], one.actions.shape[1])
    expected = (task.observation_size, task.action_size)
    same = sizes == expected
    return "" if same else f"has observations and actions of {sizes} numbers a step, but {task.name} has {expected}"


def _segments_overlap(a: Segment, b: Segment) -> bool:
    return a.episode == b.episode and a.start < b.start + len(b) and b.start < a.start + len(a)


def _half_segment(one: Segment) -> Segment:
    half = max(1, len(one) // 2)
    states = None if one.states is None else one.states[:half]
    return Segment(one.observations[:half], one.actions[:half], one.episode, one.start, states, context=one.context)


SEGMENTS = Kind(
    name="control",
    candidate=Segment,
    noun="segment",
    describe=_describe_segment,
    load=_load_segment,
    arrays=_segment_arrays,
    fault=_segment_fault,
    plain=lambda one: replace(one, states=None, gold=None),
    misfit=_segment_misfit,
    length=len,
    unit=lambda _: "steps",
    stepwise=True,
    cluster=lambda one: one.episode,
    origin=lambda one: one.episode,
    overlap=_segments_overlap,
    half=_half_segment,
    shows="clip",
    shown=lambda body: Shown(steps=body["steps"]),
    question="Which clip is better?",
    hints=(
        "Watch the clips to the end. They play in step; replay them, slow them down or go frame by frame as you like.",
        "Clips may start from different positions. Judge what is done from there on, not where it begins.",
        "How smooth or odd a movement looks only matters if the question asks for it.",
    ),
    exports={"bundle": "", "minari": ""},
    shown_file=".npz",
    behaviour="episode",
    spent="environment step",
)


# --- responses ------------------------------------------------------------------------------------------------------


def _describe_response(one: Response) -> Json:
    tokens = {"prompt_tokens": list(one.prompt_tokens), "tokens": list(one.tokens)}
    return {"prompt": one.prompt, "text": one.text, **tokens}


def _load_response(body: Fields, read: Callable[[], Arrays]) -> Response:
    return Response(body["prompt"], body["text"], tuple(body["prompt_tokens"]), tuple(body["tokens"]))


def _response_fault(one: Response) -> str:
    if not _are_text(one.prompt, one.text):
        return f"is not described as it is: {one.prompt!r:.40} and {one.text!r:.40} are not both text"
    whole = all(is_whole(token, LARGEST) for token in (*one.prompt_tokens, *one.tokens))
    return "" if whole else "has tokens that are no numbers from 0 on"


def _response_unit(some: Sequence[Response]) -> str:
    tokens = {bool(one.tokens) for one in some}
    return "tokens" if tokens == {True} else "characters" if tokens == {False} else "tokens or characters"


RESPONSES = Kind(
    name="text",
    candidate=Response,
    noun="response",
    describe=_describe_response,
    load=_load_response,
    fault=_response_fault,
    plain=lambda one: Response(one.prompt, one.text),
    tokens=lambda one: bool(one.tokens),
    length=lambda one: len(one.tokens) or len(one.text),  # characters where it comes without tokens
    unit=_response_unit,
    words=lambda one: len(one.text),
    lengthy=True,
    pipelines=("text-classification", "text-generation"),
    drifts=True,
    half=lambda one: replace(one, tokens=one.tokens[: max(1, len(one.tokens) // 2)]),
    shown=lambda body: Shown(body["prompt"], body["text"]),
    question="Which response is better?",
    hints=(
        "Read the prompt, then each response to its end. Judge the responses as answers to that prompt.",
        "Longer is not better by itself, nor is a tidier layout. *As written* shows a text without any layout.",
        "Judge a response that breaks off by what is there.",
    ),
    lease_seconds=600.0,
    looked_at=1000,
    exports={
        "judgements": ".jsonl",
        "preferences": ".jsonl",
        "csv": ".csv",
        "argilla": ".json",
        "label-studio": ".json",
        "arena": ".jsonl",
        "dataset": "",
        "bundle": "",
    },
    shown_file=".jsonl",
    start="prompt",
    behaviour="response",
    step="token",
    spent="generated token",
)


# --- pictures -------------------------------------------------------------------------------------------------------


def _picture_fault(one: Picture) -> str:
    if not _are_text(one.caption):
        return f"is not described as it is: its caption is {one.caption!r:.40}; expected text"
    if one.pixels.dtype != np.uint8:
        return f"has pixels of type {one.pixels.dtype}; expected bytes (uint8)"
    grey, colour = one.pixels.ndim == 2, one.pixels.ndim == 3 and one.pixels.shape[-1] == 3
    if not (grey or colour) or not one.pixels.size:
        return f"has pixels of shape {one.pixels.shape}; expected (H, W), or (H, W, 3)"
    return ""


def _picture_misfit(one: Picture, task: Any) -> str:
    if one.pixels.shape != task.shape:
        return f"has pixels of shape {one.pixels.shape}, but {task.name} has {task.shape}"
    known = one.caption in task.captions
    return "" if known else f"has the caption {one.caption!r:.40}; {suggest(one.caption, task.captions)}"


PICTURES = Kind(
    name="pictures",
    candidate=Picture,
    noun="picture",
    describe=lambda one: {"caption": one.caption},
    load=lambda body, read: Picture(body["caption"], read()["pixels"]),
    arrays=lambda one: {"pixels": one.pixels},
    fault=_picture_fault,
    plain=lambda one: replace(one, gold=None),
    misfit=_picture_misfit,
    length=lambda one: one.pixels.size,
    unit=lambda _: "pixels",
    pipelines=("image-classification", "text-to-image"),
    drifts=True,
    shows="clip",
    still=True,
    shown=lambda body: Shown(prompt=body["caption"], steps=1),
    exports={"bundle": "", "pick-a-pic": ".parquet"},
    question="Which picture fits its caption better?",
    hints=(
        "Read the caption, then look at each picture as a whole. Small pictures are shown enlarged.",
        "Judge how well a picture fits the caption, not how tidy it is, unless the caption asks for that.",
    ),
    start="caption",
    behaviour="picture",
    step="picture",
    spent="picture",
)


# --- looked up ------------------------------------------------------------------------------------------------------


@cache
def plugins() -> tuple[Kind[Any], ...]:
    """Kinds that installed packages bring, through the entry-point group `prefrl.kinds`."""
    return tuple(point.load() for point in entry_points(group="prefrl.kinds"))


def kinds() -> Iterator[Kind[Any]]:
    """All of them; what packages bring is loaded only when none of our own will do."""
    yield from (SEGMENTS, RESPONSES, PICTURES)
    yield from plugins()


def find(name: str) -> Kind[Any] | None:
    """The kind of that name, None where there is none."""
    return next((kind for kind in kinds() if kind.name == name), None)


def named(name: str) -> Kind[Any]:
    """The kind of that name. Raises `ValueError` with the nearest one."""
    found = find(name)
    if found is None:
        raise ValueError(f"unknown kind of candidate {name!r}; {suggest(name, [kind.name for kind in kinds()])}")
    return found


def logged(noun: Any) -> Kind[Any]:
    """The kind that the log calls so. Raises `ValueError` for one that is not known here."""
    found = next((kind for kind in kinds() if kind.noun == noun), None)
    if found is None:
        raise ValueError(f"unknown type of candidate {noun!r:.40}; it may need a package that is not installed")
    return found


def kind_of(candidate: Candidate) -> Kind[Any]:
    """The kind of a candidate. Raises `TypeError` for what is none."""
    found = next((kind for kind in kinds() if isinstance(candidate, kind.candidate)), None)
    if found is None:
        raise TypeError(f"expected a candidate of a known kind, got {type(candidate).__name__}")
    return found


def only(cls: type[C], candidates: Iterable[Candidate], error: Exception) -> list[C]:
    """Candidates, known to be of one class: for code that is at home in one kind. Raises `error` for others."""
    found = []
    for candidate in candidates:
        if not isinstance(candidate, cls):
            raise error
        found.append(candidate)
    return found
