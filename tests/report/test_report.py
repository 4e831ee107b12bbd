"""The report of a run: whole, half-done, empty, hostile."""

import json
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import matplotlib
import pytest
from PIL import Image

from prefrl.report.facts import gather
from prefrl.report.records import MAX_TEXT, Example, number, read, visible
from prefrl.report.report import write_report
from prefrl.report.words import changes, headline, show_count, show_number, show_share, show_time, verdict

WILD = "</pre></title><script>alert(1)</script><img src=x onerror=alert(1)>\u202e\u2066\"'{{ 7*7 }}\x00\x1b[31m\ud800"
CSP = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
INSIDE = ("data:image/png;base64,", "data:image/webp;base64,", "#")
VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Collects what a browser would act on, and checks that tags close in order."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: set[str] = set()
        self.attributes: list[tuple[str, str, str]] = []
        self.ids: list[str] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self.ids += [value or "" for name, value in attrs if name == "id"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def line(round: int, **more: Any) -> dict[str, Any]:
    base = {"evaluate/gold": -100.0 + 10 * round, "evaluate/gold_std": 5.0, "evaluate/learned": 0.1 * round}
    base |= {"label/asked": 11 * round, "label/answered": 10 * round, "label/skipped": round}
    base |= {"steps/learn": 1000 * round, "steps/query": 10 * round, "steps/evaluate": 50, "seconds/evaluate": 0.5}
    if round:
        base |= {"fit/accuracy": 0.9, "fit/accuracy_held_out": 0.8, "fit/loss": 0.3, "fit/loss_held_out": 0.5}
        base |= {"seconds/sample": 0.1, "seconds/label": 0.2, "seconds/fit": 0.3, "seconds/improve": 2.0}
    return {"round": round} | base | more


def summary(**more: Any) -> dict[str, Any]:
    base: dict[str, Any] = {"task": "Pendulum-v1", "kind": "control", "seed": 7, "rounds": 3}
    base |= {"gold_before": -100.0, "gold_after": -70.0, "gold_best": -70.0, "reward_accuracy": 0.8, "kl": None}
    base |= {"labels": {"asked": 33, "answered": 30, "skipped": 3}, "fluency_before": None, "fluency_after": None}
    base |= {"steps": {"learn": 3000, "query": 30, "evaluate": 50}, "versions": {"prefrl": "0.1.0"}}
    base |= {"seconds": {"sample": 0.3, "label": 0.6, "fit": 0.9, "improve": 6.0, "evaluate": 2.0, "total": 12.0}}
    return base | more


def run_folder(folder: Path, lines: list[dict[str, Any]], **files: Any) -> Path:
    (folder / "examples").mkdir(parents=True)
    (folder / "metrics.jsonl").write_text("".join(json.dumps(one) + "\n" for one in lines))
    (folder / "config.yaml").write_text("task:\n  kind: control\nloop:\n  rounds: 3\n")
    for name, value in files.items():
        where = folder / "examples" if name in ("before", "after") else folder
        (where / f"{name}.json").write_text(json.dumps(value))
    return folder


def whole_run(folder: Path, **more: Any) -> Path:
    lines = [line(i) for i in range(4)]
    held_out = {"round": 3, "predicted": [0.9, 0.2, 0.6, 0.8], "preference": [1.0, 0.0, 0.5, 0.0]}
    examples = [{"gold": -1.5, "learned": 0.25, "strip": "before-0.png"}]
    run_folder(folder, lines, summary=summary(**more), held_out=held_out, before=examples, after=examples)
    Image.new("RGB", (12, 4)).save(folder / "examples" / "before-0.png")
    return folder


def page(folder: Path) -> Page:
    return Page(write_report(folder).read_text("utf-8"))


def check_harmless(found: Page) -> None:
    """Nothing is loaded, nothing runs, and no id is there twice."""
    assert not found.tags & {"script", "iframe", "object", "embed", "link", "base", "form", "foreignobject"}
    assert not [name for _, name, _ in found.attributes if name.startswith("on")]
    for _, name, value in found.attributes:
        assert name not in ("src", "href", "xlink:href") or value.startswith(INSIDE)
    assert len(found.ids) == len(set(found.ids))


def test_a_whole_run_is_told_in_one_harmless_page(tmp_path: Path) -> None:
    found = page(whole_run(tmp_path / "run"))
    check_harmless(found)
    assert "Gold rose from −100 to −70 in 3 rounds (30 labels, 3,080 environment steps, 12 s)." in found.text
    assert "Not there yet" not in found.text
    assert "not finished" not in found.text
    assert "What is not there" not in found.text
    assert found.text.count("gold −1.50") == 2
    for word in ("seed 7", "hidden from the learner", "no absolute scale", "kind: control", "2.2 s of them outside"):
        assert word in found.text


@pytest.mark.parametrize(
    ("learned", "kl", "told"),
    [
        (
            (0.0, 0.5, 0.9, 0.8),
            (0.0, 1.0, 2.0, 4.0),
            "Since round 2 it went from 2.00 to 4.00 nats away from its start",
        ),
        ((0.0, 0.5, 0.9, 0.9), (0.0, 1.0, 2.0, 4.0), "Since round 2"),
        ((0.0, 0.5, 0.9, 1.0), (0.0, 1.0, 2.0, 4.0), ""),  # it rose
        ((0.0, 0.5, 0.9, 0.8), (0.0, 1.0, 2.0, 2.2), ""),  # no farther
        ((0.0, 0.5, 0.9, 0.8), (0.0, 1.0, 9.0, 10.0), ""),  # hardly farther
    ],
)
def test_a_distance_that_grows_for_nothing_is_warned_of(
    learned: tuple[float, ...], kl: tuple[float, ...], told: str, tmp_path: Path
) -> None:
    rounds = [{"evaluate/learned": a, "evaluate/kl": b} for a, b in zip(learned, kl, strict=True)]
    fixed = [{k: v for k, v in (line(i) | one).items() if not k.startswith("fit/")} for i, one in enumerate(rounds)]
    remark = verdict(gather(read(run_folder(tmp_path / "fixed", fixed))))
    assert told in remark
    assert ("did not rise" in remark) is bool(told)
    # Each round's own reward has a scale of its own: nothing can be said of it, unless the newest scored them all.
    fitted = [line(i) | one for i, one in enumerate(rounds)]
    assert "did not rise" not in verdict(gather(read(run_folder(tmp_path / "fitted", fitted))))
    seen = [{"round": i, "learned": {"value": x, "count": 9}, "won": {"count": 9}} for i, x in enumerate(learned)]
    newest = run_folder(tmp_path / "newest", fitted, hindsight={"fitted_round": 3, "rounds": seen})
    assert ("did not rise" in verdict(gather(read(newest)))) is bool(told)


@pytest.mark.parametrize(("size", "shown"), [(1e-13, False), (1e-3, True)])
def test_a_number_that_changes_by_rounding_has_no_curve(size: float, shown: bool, tmp_path: Path) -> None:
    lines = [line(i, **{"improve/kl_old": size * (1 + i)}) for i in range(4)]
    assert ("Step size" in page(run_folder(tmp_path / "run", lines, summary=summary())).text) is shown


def test_labels_are_drawn_where_there_are_any(tmp_path: Path) -> None:
    told = "Queries asked, answered and skipped so far."
    assert told in page(whole_run(tmp_path / "labels")).text
    none = {"asked": 0, "answered": 0, "skipped": 0}
    assert told not in page(whole_run(tmp_path / "none", labels=none)).text
    before_any = [line(0, **{f"label/{name}": 0 for name in none})]
    assert told in page(run_folder(tmp_path / "begun", before_any)).text


def test_text_runs_show_kl_and_fluency(tmp_path: Path) -> None:
    lines = [line(i, **{"evaluate/kl": 2.0 * i, "evaluate/fluency": 1 - 0.1 * i}) for i in range(4)]
    said = {"kind": "text", "kl": 6.0, "fluency_before": 1.0, "fluency_after": 0.7}
    found = page(run_folder(tmp_path / "run", lines, summary=summary(**said)))
    assert "Fluency fell from 100 % to 70 %." in found.text
    assert "generated tokens" in found.text
    assert "Gold for each nat of KL" in found.text


def test_it_is_honest_when_the_policy_got_worse(tmp_path: Path) -> None:
    found = page(whole_run(tmp_path / "run", gold_after=-102.0, gold_best=-80.0))
    assert "Gold fell from −100 to −102" in found.text
    assert "The policy got worse." in found.text
    assert "smaller than one standard deviation" in found.text
    assert "it has been better than it ended" in found.text


def test_rounds_that_were_undone_are_named_and_drawn(tmp_path: Path) -> None:
    lines = [line(0), line(1), line(2, **{"evaluate/undone_gold": -300.0}), line(3, **{"evaluate/undone_gold": -200.0})]
    found = page(run_folder(tmp_path / "run", lines, summary=summary()))
    assert "Undone, since the newest reward saw a clear loss: round 2, 3." in found.text
    assert "of the policy that stands" in found.text
    assert "Undone" not in page(whole_run(tmp_path / "other")).text


def test_a_learned_world_is_held_against_the_real_one(tmp_path: Path) -> None:
    def dreamt(i: int, reach: float) -> dict[str, Any]:
        world = {"improve/world_held_out": 0.1 / i, "improve/reach": reach, "improve/branch": 0.9 * reach}
        return line(i, **world, **{"evaluate/imagined": 0.2 * i})

    folder = run_folder(tmp_path / "run", [line(0), dreamt(1, 20.0), dreamt(2, 30.0)], summary=summary())
    found = page(folder)
    assert "about what the policy would do" not in found.text
    (folder / "config.yaml").write_text("select: {kind: uniform, imagined: true}")
    assert (
        "They are about what the policy would do, imagined in its learned world, or about what it did"
        in page(folder).text
    )
    assert "Imagined and real return" in found.text
    assert "Error of the learned world" in found.text
    assert "stopped dreaming" not in found.text
    asleep = page(run_folder(tmp_path / "other", [line(0), dreamt(1, 20.0), dreamt(2, 0.0)], summary=summary()))
    assert "The run stopped dreaming where they have no steps." in asleep.text
    assert "learned world" not in page(whole_run(tmp_path / "third")).text


def test_without_gold_nothing_is_claimed(tmp_path: Path) -> None:
    lines = [line(i, **{"evaluate/gold": float("nan"), "evaluate/gold_std": None}) for i in range(3)]
    missing = {"gold_before": None, "gold_after": None, "gold_best": None}
    found = page(run_folder(tmp_path / "run", lines, summary=summary(**missing)))
    assert "There is no gold to tell whether it helped, in 3 rounds" in found.text


def seen(rounds: int, **won: float) -> dict[str, Any]:
    """A hindsight in which every round but the first wins so often."""
    learned = {"value": 1.0, "low": 0.5, "high": 1.5, "count": 20}
    rows = [{"round": i, "learned": learned, "won": {"count": 20} | won if i else {}} for i in range(rounds)]
    return {"fitted_round": 3, "rounds": rows}


def test_without_gold_the_win_rate_stands_in_its_place_and_no_panel_is_empty(tmp_path: Path) -> None:
    blind = {"evaluate/gold": None, "evaluate/gold_std": None, "improve/entropy": 1.0}
    lines = [line(i, **blind) for i in range(4)]
    said = summary(gold_before=None, gold_after=None, gold_best=None)
    folder = run_folder(tmp_path / "run", lines, summary=said, hindsight=seen(4, value=0.95, low=0.76, high=0.99))
    found = page(folder)
    assert "The policy beats its start in 95 % of its episodes, in 3 rounds" in found.text
    assert "95 % of 20 episodes are worth more than the start's (95 % interval 76 % to 99 %)." in found.text
    for word in ("Gold, hidden", "Do the two agree?", "Calibration", "That may be chance"):
        assert word not in found.text
    assert found.text.count("Not there yet") == 2  # the examples, which are missing


def test_a_win_rate_that_may_be_chance_is_called_so(tmp_path: Path) -> None:
    chance = seen(2, value=0.6, low=0.4, high=0.8)
    folder = run_folder(tmp_path / "run", [line(0), line(1)], summary=summary(), hindsight=chance)
    assert "That may be chance." in page(folder).text


def test_a_reward_that_the_run_began_with_is_not_called_fitted(tmp_path: Path) -> None:
    lines = [{key: value for key, value in line(i).items() if not key.startswith("fit/")} for i in range(4)]
    found = page(run_folder(tmp_path / "run", lines, summary=summary()))
    assert "the reward that the run began with, the same in all rounds" in found.text
    assert "anew" not in found.text
    assert "Was the reward model right?" not in found.text


def test_a_run_that_was_shown_what_to_do_says_that_nothing_was_compared(tmp_path: Path) -> None:
    lines = [
        line(0),
        line(1, **{"improve/demonstrations": 4, "improve/cloning_loss": 0.3}) | {"evaluate/learned": None},
    ]
    unfitted = [{k: v for k, v in one.items() if not k.startswith("fit/")} for one in lines]
    found = page(run_folder(tmp_path / "run", unfitted, summary=summary()))
    assert "It learned from 4 demonstrations; nothing was compared." in found.text
    fitted = page(run_folder(tmp_path / "both", [line(0), line(1, **{"improve/demonstrations": 4})], summary=summary()))
    assert "nothing was compared" not in fitted.text


def test_what_judgements_and_demonstrations_had_in_a_fit_is_shown(tmp_path: Path) -> None:
    both = {"fit/trained/judged": 54, "fit/weight/judged": 54.0, "fit/held_out/judged": 6, "fit/loss_share/judged": 0.7}
    both |= {"fit/trained/shown": 9, "fit/weight/shown": 4.5, "fit/held_out/shown": 1, "fit/loss_share/shown": 0.3}
    both |= {"fit/accuracy_held_out/judged": 0.8, "fit/accuracy_held_out/shown": 1.0, "label/demonstrations": 10}
    lines = [line(0), line(1, **both), line(2, **both), line(3, **both)]
    labels = {"asked": 70, "answered": 70, "skipped": 0, "demonstrations": 10}
    found = page(run_folder(tmp_path / "run", lines, summary=summary(labels=labels)))
    assert "In the newest fit 6 judgements and 1 demonstration were held out." in found.text
    assert "trained on 54 judgements of weight 54.0 and 9 demonstrations of weight 4.50" in found.text
    assert "(10 demonstrations and 60 other labels" in found.text
    assert "70 asked, 0 skipped; 10 demonstrations" in found.text
    plain = page(run_folder(tmp_path / "plain", [line(0), line(1)], summary=summary()))
    assert "Shares of the loss" not in plain.text
    assert "demonstration" not in plain.text


def test_mistakes_are_added_up_beside_the_lines_of_the_measured_eps(tmp_path: Path) -> None:
    """After 4 steps 0.1 + 0.3 + (0.3 + 0.5) / 2 = 0.8; eps H is 0.4 and eps H^2 / 2 is 0.8."""
    rounds = [
        {"round": 0, "eps": 0.5, "error": [0.5] * 4, "running": [1.0] * 4},
        {"round": 3, "eps": 0.1, "error": [0.1, 0.3, 0.3, 0.5], "running": [1.0, 1.0, 0.5, 0.5]},
    ]
    folder = run_folder(tmp_path / "run", [line(i) for i in range(4)], summary=summary())
    (folder / "shift.json").write_text(json.dumps({"episodes": 2, "every": 1, "rounds": rounds}))
    found = page(folder)
    assert "Does it follow the expert?" in found.text
    assert (
        "eps, 0.10, is the mean error of round 3 over all steps of as many episodes of the expert's own." in found.text
    )
    assert "After 4 steps the newest policy has 0.80, which is 2.00 times eps H and 1.00 times eps H²/2." in found.text
    rounds[1]["eps"] = 0.0
    (folder / "shift.json").write_text(json.dumps({"episodes": 2, "every": 1, "rounds": rounds[1:]}))
    assert "errs nowhere in the expert's own episodes" in page(folder).text
    (folder / "shift.json").write_text('{"episodes": 2}')
    assert "shift.json: cannot be read" in page(folder).text


def test_a_world_that_is_known_exactly_has_maps_and_a_regret(tmp_path: Path) -> None:
    cells = [[0, 0], [0, 1], [1, 1]]
    found: dict[str, Any] = {"rows": ["S.", "#G"], "cells": cells, "gold": [0, 0, 1], "learned": [], "discount": 0.95}
    found |= {"visits": [0.2, 0.3, 0.5], "worth": [1.1, 1.5, 2.0], "moves": [[0, 1], [1, 0], [0, 1]]}
    found["rounds"] = [{"round": 0, "regret": 0.4}, {"round": 1, "regret": 0.025}]
    folder = run_folder(tmp_path / "run", [line(i) for i in range(2)], summary=summary())
    (folder / "exact.json").write_text(json.dumps(found))
    text = page(folder).text
    assert "The newest misses 2.5%." in text
    assert "Where the policy goes, and how often it is there" in text
    assert "What was learned of it" not in text  # nothing was fitted, and the run is over
    for wrong in ({"worth": [1.0]}, {"cells": [[0, 0], [0, 1], [2, 1]]}, {"cells": [[0, 0], [0, 1], [1, 2]]}):
        (folder / "exact.json").write_text(json.dumps(found | wrong))
        assert "exact.json: cannot be read" in page(folder).text


def test_each_of_several_tasks_has_a_curve(tmp_path: Path) -> None:
    lines = [line(i, **{"evaluate/gold/mars": 1.0 * i, "evaluate/gold/<blink>earth": -1.0}) for i in range(4)]
    found = page(run_folder(tmp_path / "run", lines, summary=summary()))
    assert "Gold of each task" in found.text
    assert "mars" in found.text
    assert "<blink>earth" in found.text
    assert "blink" not in found.tags


def test_a_folder_of_demonstrations_alone_says_how_many_there_are(tmp_path: Path) -> None:
    (tmp_path / "labels.json").write_text(json.dumps({"asked": 4, "answered": 4, "skipped": 0, "demonstrations": 4}))
    found = page(tmp_path)
    assert "No round is over yet; there are 4 demonstrations." in found.text
    assert "4 asked, 0 skipped; 4 demonstrations" in found.text


def test_noise_is_told_from_change_by_the_intervals_of_the_means(tmp_path: Path) -> None:
    lines = [line(i, **{"evaluate/count": 100.0, "evaluate/gold_std": 40.0}) for i in range(2)]
    near = page(run_folder(tmp_path / "near", lines, summary=summary(gold_after=-95.0)))
    far = page(run_folder(tmp_path / "far", lines, summary=summary(gold_after=-70.0)))
    assert "The change is within the noise of 100 episodes." in near.text
    assert "within the noise" not in far.text
    assert "The band is the 95 % interval of the mean." in far.text


def test_words_that_are_new_are_marked() -> None:
    before, after = (Example(None, None, "p", text, "", "") for text in ("a good film", "a very good film indeed"))
    assert changes(before, after) == [("a", False), (" very", True), (" good film", False), (" indeed", True)]
    assert changes(None, after) == [(after.text, False)]


def test_a_run_still_going_on_says_so(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "half", [line(i) for i in range(3)])
    with (folder / "metrics.jsonl").open("a") as file:
        file.write('{"round": 3, "evaluate/go')
    said = summary(rounds=2, gold_after=-80.0)
    found = page(folder)
    (folder / "summary.json").write_text(json.dumps(said))  # it is written after each round
    assert "not finished: round 2 of 3" in page(folder).text
    check_harmless(found)
    assert "Gold rose from −100 to −80 so far, in 2 rounds (20 labels, 2,070 environment steps" in found.text
    assert "not finished: round 2 of 3" in found.text
    assert "summary.json: no round is over yet" in found.text
    assert "metrics.jsonl: 1 of its lines cannot be read" in found.text
    assert "after.json: no examples yet" in found.text


def test_an_empty_folder_gives_a_page_and_no_folder_an_error(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert "No round is over yet." in page(tmp_path / "empty").text
    with pytest.raises(NotADirectoryError, match="folder of a run"):
        write_report(tmp_path / "nowhere")


def test_hostile_text_is_shown_and_not_obeyed(tmp_path: Path) -> None:
    example = {"gold": 1, "learned": 2, "prompt": WILD, "text": WILD + "x" * 300_000, "caption": WILD}
    said = summary(task=WILD, kind=WILD, versions={WILD: WILD, "b": "\u202e"})
    folder = run_folder(tmp_path / "run", [line(0), line(1)], summary=said, before=[example], after=[example])
    (folder / "config.yaml").write_bytes(WILD.encode("utf-8", "surrogatepass") + b"\xff")
    written = write_report(folder).read_text("utf-8")
    found = Page(written)
    check_harmless(found)
    assert "<script>alert(1)</script>" in found.text  # as text
    assert "{{ 7*7 }}" in found.text
    assert "⟨U+202E⟩⟨U+2066⟩" in found.text
    assert "⟨U+001B⟩" in found.text
    assert not set(written) & set("\u202e\u2066\x00\x1b")
    assert "more characters]" in found.text
    assert len(written) < 500_000
    assert ("meta", "content", CSP) in found.attributes  # a second lock: no script may run, nothing be loaded


@pytest.mark.parametrize(
    ("rounds", "why"), [(1, "no reward model has been fitted yet"), (2, "nothing could be held out")]
)
def test_why_nothing_was_held_out_is_said(tmp_path: Path, rounds: int, why: str) -> None:
    record = read(run_folder(tmp_path / "run", [line(i) for i in range(rounds)]))
    assert f"held_out.json: {why}" in record.missing


WRONG = (None, -3, "x", [None], True, "[" * 100_000, {"total": [[1]]})


def wrong_run(folder: Path, wild: Any) -> Path:
    """A run that has the same wrong value everywhere."""
    keys = ("gold_before", "rounds", "labels", "steps", "seconds", "versions", "kl", "seed", "task", "kind")
    lines = [{"round": 0} | dict.fromkeys(line(1), wild) | {"round": 0}, line(1), {"round": wild}]
    examples = [wild, {"gold": wild, "learned": wild, "prompt": wild, "text": wild, "strip": wild}]
    held_out = {"round": wild, "predicted": wild, "preference": wild}
    files = {"summary": dict.fromkeys(keys, wild), "held_out": held_out, "before": examples, "after": wild}
    return run_folder(folder, lines, **files)


def spoil(folder: Path, wild: Any) -> None:
    """Put the value in the place of whole files."""
    for name in ("summary.json", "metrics.jsonl", "held_out.json", "examples/before.json"):
        (folder / name).write_text(wild if isinstance(wild, str) else json.dumps(wild))


@pytest.mark.parametrize("wild", WRONG)
def test_wrong_types_anywhere_are_read_as_missing(tmp_path: Path, wild: Any) -> None:
    """What is drawn is what was read: numbers that can be drawn, or nothing."""
    folder = wrong_run(tmp_path / "run", wild)
    for _ in range(2):
        record = read(folder)
        facts = gather(record)
        for told in (headline(facts), verdict(facts)):
            assert told is not None
        for key in line(1):
            assert all(value is None or isinstance(value, float) for value in record.series(key))
        spoil(folder, wild)


@pytest.mark.parametrize("wild", [{"total": [[1]]}, *(pytest.param(wild, marks=pytest.mark.slow) for wild in WRONG)])
def test_wrong_types_anywhere_never_crash_the_page(tmp_path: Path, wild: Any) -> None:
    folder = wrong_run(tmp_path / "run", wild)
    check_harmless(page(folder))
    spoil(folder, wild)
    check_harmless(page(folder))


@pytest.mark.parametrize("value", [-1e308, 9e14, 10**400, 1e-300])
def test_wild_numbers_never_crash_it(tmp_path: Path, value: float) -> None:
    keys = [key for key in line(1) if key != "round"]
    lines = [{"round": i} | dict.fromkeys(keys, value) for i in range(2)] + [line(2)]
    held_out = {"predicted": [value, 0.5], "preference": [0.5, value]}
    check_harmless(page(run_folder(tmp_path / "run", lines, held_out=held_out)))


def test_a_judge_that_follows_the_order_is_shown(tmp_path: Path) -> None:
    said = {"label/pairs": 8.0, "label/refused": 0.25, "label/position_bias": 0.5, "label/flipped": 1.0}
    found = page(run_folder(tmp_path / "judge", [line(0), line(1, **said), line(2, **said)]))
    assert "Was the judge fair?" in found.text
    assert "In the newest round that is 0.50." in found.text
    assert "Was the judge fair?" not in page(run_folder(tmp_path / "oracle", [line(0), line(1)])).text


def test_only_png_files_of_the_examples_folder_are_shown(tmp_path: Path) -> None:
    names = ["../secret.png", "/etc/passwd", "text.png", "link.png", "gone.png", "", ".", "a\0.png", "x" * 5000]
    folder = run_folder(tmp_path / "run", [line(0)], before=[{"strip": name} for name in names])
    Image.new("RGB", (4, 4)).save(folder / "secret.png")
    (folder / "examples" / "text.png").write_text("no picture")
    (folder / "examples" / "link.png").symlink_to(folder / "secret.png")
    found = page(folder)
    assert "img" not in found.tags
    assert found.text.count("The picture is") == len(names)


def test_figures_are_well_formed_and_take_the_pages_colours(tmp_path: Path) -> None:
    html = write_report(whole_run(tmp_path / "run")).read_text("utf-8")
    figures = [part.split("</svg>")[0] + "</svg>" for part in html.split("<svg")[1:]]
    assert len(figures) == 9
    for figure in figures:
        ElementTree.fromstring("<svg" + figure)
        assert "#0101" not in figure
    assert all("var(--muted)" in figure for figure in figures)


def test_the_same_folder_gives_the_same_bytes_and_leaves_nothing_behind(tmp_path: Path) -> None:
    folder = whole_run(tmp_path / "run")
    before = {path.name for path in folder.iterdir()}
    first = write_report(folder).read_bytes()
    with matplotlib.rc_context({"text.usetex": True, "font.size": 30}):  # as in somebody's matplotlibrc
        assert write_report(folder).read_bytes() == first
    assert {path.name for path in folder.iterdir()} == before | {"report.html"}


def test_a_failed_write_keeps_the_old_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = whole_run(tmp_path / "run")
    (folder / "report.html").write_text("old")

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_report(folder)
    assert (folder / "report.html").read_text() == "old"
    assert not list(folder.glob(".*"))


def test_a_round_that_is_logged_twice_counts_once(tmp_path: Path) -> None:
    record = read(run_folder(tmp_path / "run", [line(0), line(2), line(1), line(1, **{"evaluate/gold": 5})]))
    assert record.series("evaluate/gold") == [-100.0, 5.0, -80.0]


def test_numbers_are_shown_as_people_read_them() -> None:
    shown = [show_number(x) for x in (-1250.4, 12.34, 0.6234, 0.0123, 0.0, 1e-5, None)]
    assert shown == ["−1,250", "12.3", "0.62", "0.012", "0", "1.0e−05", "–"]
    assert show_number(0.02, beside=0.71) == "0.02"
    assert show_share(0.876) == "88\u00a0%"
    assert [show_time(x) for x in (0.25, 41, 119.7, 7325)] == ["250 ms", "41 s", "2 min 0 s", "2 h 2 min"]
    assert [show_count(1, "label"), show_count(2000, "label"), show_count(None)] == ["1 label", "2,000 labels", "–"]
    assert number(True) is None


def test_long_texts_say_how_much_is_left_out() -> None:
    assert visible("y" * (MAX_TEXT + 1234)).endswith("y … [1,234 more characters]")
    assert visible("a\tb\nc") == "a\tb\nc"
