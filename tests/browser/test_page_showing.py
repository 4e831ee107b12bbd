"""People show what to do: actions step by step with keys alone, and responses written anew; nothing of it is lost."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from browser.child import Start, free_port, serve_command
from browser.house import CONFIG, POINT, STEPS, House, Open, fill, segment
from browser.visitor import LOST, Visit, Visitor
from playwright.sync_api import Browser, expect

from prefrl.envs.toys import TMazeSettings
from prefrl.improve.clone import CloneSettings
from prefrl.page.shown import TextShowing
from prefrl.reward_models.mlp import MLPSettings
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

pytestmark = pytest.mark.browser
CORRECTIONS, REWRITES = 40, 10
ACTION = ["labeler.ask=action"]
Make = Callable[[Path, int], Path]


@pytest.fixture
def singles(drawn: Path) -> Make:
    """A folder with so many clips to correct, which are drawn already."""

    def make(folder: Path, count: int) -> Path:
        fill(folder, [Query((segment(number),)) for number in range(count)])
        shutil.copytree(drawn / "clips", folder / "clips")
        return folder

    return make


def keys(visitor: Visitor, *names: str) -> None:
    for name in names:
        visitor.page.keyboard.press(name)


def correct(visitor: Visitor, turn: int) -> str:
    """All the way to the right, and from a step on down as well; by keys alone."""
    id = visitor.question()
    keys(visitor, "Shift+ArrowUp", *["ArrowRight"] * turn, "2", "Shift+ArrowDown", "Enter")
    visitor.gone(id)
    return id


def meant(turn: int) -> Any:
    """What `correct` says; the clips of a test house stand still, so that what it leaves alone is 0."""
    return np.array([[1.0, 0.0]] * turn + [[1.0, -1.0]] * (STEPS - turn), np.float32)


def test_of_40_corrections_by_keys_none_is_lost_as_the_server_is_killed_and_they_are_cloned(
    tmp_path: Path, singles: Make, chromium: Browser, visit: Visit, start: Start
) -> None:
    folder, port = singles(tmp_path / "clips", CORRECTIONS), free_port()
    server = start(*serve_command(folder, port, ACTION))
    waiting = chromium.new_page()
    me = visit(server.link(waiting), reduced_motion="reduce")
    me.allowed.append(LOST)
    me.go("/label")
    given: dict[str, int] = {}
    for number in range(CORRECTIONS):
        if number == CORRECTIONS // 2:
            server.kill()
        if number == CORRECTIONS // 2 + 2:  # two were sent to a server that is not there
            expect(me.test("save-state")).to_have_attribute("data-state", "offline")
            server = start(*serve_command(folder, port, ACTION))
            server.link(waiting)
        turn = 1 + number % 5
        given[correct(me, turn)] = turn
    me.saved()
    waiting.close()
    server.kill()
    with Store[Segment](folder) as store:
        shown = {one.query.id: one for one in store.demonstrations()}
        assert len(shown) == len(given) == CORRECTIONS
        asked = {one["id"]: one["subject"] for one in store.events() if one["kind"] == "assign"}
        for id, turn in given.items():
            np.testing.assert_array_equal(shown[asked[id]].like.actions, meant(turn))
        losses = cloned(store)
    assert losses[-1] < losses[0] / 2, losses


def cloned(store: Store[Segment]) -> list[float]:
    rng, task = np.random.default_rng(0), POINT.build()
    learner = CloneSettings(cloning_epochs=2).build(task, rng)
    reward = MLPSettings(hidden=(4,)).build(task, rng)
    return [learner.improve(reward, store, rng)["cloning_loss"] for _ in range(12)]


@pytest.fixture
def clip_house(tmp_path: Path, singles: Make, open_house: Open) -> House:
    return open_house(singles(tmp_path / "clips", 6), kind="control", ask="action")


def test_an_answer_holds_until_the_next_one_and_every_step_needs_one(clip_house: House, visit: Visit) -> None:
    ann = visit(clip_house.link("ann"), reduced_motion="reduce")
    id = ann.question()
    keys(ann, "ArrowRight", "ArrowRight", "ArrowUp", "ArrowUp")
    expect(ann.test("submit-actions")).to_contain_text("Steps 1 to 2")
    keys(ann, "Enter")  # goes to what has no answer, and sends nothing
    expect(ann.test("acting")).to_contain_text("Step 1 of 15")
    ann.shows_frames(0)
    keys(ann, "p", "Enter")
    ann.gone(id)
    ann.saved()
    (one,) = clip_house.store.demonstrations()
    assert one.like.actions[:, 0].tolist() == [0.0] * 2 + [np.float32(0.2)] * (STEPS - 2)
    ann.page.keyboard.press("z")
    ann.question_is(id)
    keys(ann, *["ArrowRight"] * 3)
    expect(ann.test("act-state")).to_have_text("set at step 3")
    keys(ann, "Backspace", "Enter")
    ann.gone(id)
    ann.saved()
    (one,) = clip_house.store.demonstrations()
    assert one.like.id == one.query.candidates[0].id, "all as the policy did"


def test_the_mouse_does_what_the_keys_do_and_a_reload_keeps_what_was_begun(clip_house: House, visit: Visit) -> None:
    ann = visit(clip_house.link("ann"), reduced_motion="reduce")
    id = ann.question()
    ann.test("slider-1").fill("0.5")
    track = ann.test("dimension-0").locator("svg.track")
    box = track.bounding_box()
    track.click(position={"x": box["width"] * 10.5 / STEPS, "y": box["height"] / 2})
    ann.shows_frames(10)
    ann.test("act-own").click()
    ann.page.reload()
    assert ann.question() == id
    ann.test("submit-actions").click()
    ann.gone(id)
    ann.saved()
    (one,) = clip_house.store.demonstrations()
    assert one.like.actions.tolist() == [[0.0, 0.5]] * 10 + [[0.0, 0.0]] * 5
    assert clip_house.about()[0]["input"] == "mouse"


def test_numbers_choose_discrete_actions_by_their_names(
    tmp_path: Path, open_house: Open, visit: Visit, monkeypatch: pytest.MonkeyPatch
) -> None:
    maze = TMazeSettings(length=4)
    states = np.array([[place, 1.0, 0.0, place] for place in range(4)])
    own = Segment(np.zeros((4, 2), np.float32), np.eye(3, dtype=np.float32)[[0, 1, 0, 1]], "e", 0, states)
    folder = fill(tmp_path / "maze", [Query((own,))])
    (folder / "config.yaml").write_text(CONFIG.replace(f"point, segment_steps: {STEPS}", "tmaze, length: 4"))
    monkeypatch.setattr("browser.house.POINT", maze)
    ann = visit(open_house(folder, kind="control", ask="action").link("ann"), reduced_motion="reduce")
    id = ann.question()
    expect(ann.test("move-1")).to_contain_text("left")
    expect(ann.test("move-0")).to_have_class("move policys")
    keys(ann, "1", "ArrowRight", "ArrowRight", "ArrowRight", "3", "ArrowUp", "ArrowDown", "Enter")
    ann.gone(id)
    ann.saved()
    with Store[Segment](folder, write=False) as store:
        (one,) = store.demonstrations()
    assert one.like.actions.argmax(1).tolist() == [0, 0, 0, 2]


@pytest.fixture
def text_house(tmp_path: Path, open_house: Open, monkeypatch: pytest.MonkeyPatch) -> House:
    words = TextShowing(12, lambda text: (*range(1, len(text.split()) + 1), 0))
    monkeypatch.setattr("browser.house.showing", lambda ask, task: words)
    queries = [Query((Response(f"Story {n} begins", " and it ends badly, as they do"),)) for n in range(REWRITES)]
    return open_house(fill(tmp_path / "texts", queries), ask="rewrite")


def test_ten_responses_are_written_anew(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"), reduced_motion="reduce")
    for number in range(REWRITES):
        id = ann.question()
        expect(ann.test("submit-text")).to_be_disabled()  # nothing was changed yet
        ann.page.keyboard.press("Control+a")
        ann.page.keyboard.type(f" and it ends well, number {number}")
        ann.page.keyboard.press("Control+Enter")
        ann.gone(id)
    ann.saved()
    shown = text_house.store.demonstrations()
    assert [one.like.text for one in shown] == [f" and it ends well, number {n}" for n in range(REWRITES)]
    for one in shown:
        implied = one.implied(1.0)
        assert implied is not None
    ann.go("/history")
    expect(ann.test("entry").first).to_contain_text("number 9")


def test_differences_are_marked_and_what_is_too_long_or_empty_cannot_be_sent(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"), reduced_motion="reduce")
    id = ann.question()
    field, send, note = (ann.test(name) for name in ("draft", "submit-text", "draft-note"))
    field.fill(" and it ends well, as they do")
    expect(ann.page.locator(".slot[data-slot='0'] mark.alone")).to_have_text("badly")
    expect(ann.page.locator(".draft-behind mark.alone")).to_have_text("well")
    expect(ann.test("draft-count")).to_have_text("8 of 12 tokens")
    expect(send).to_be_enabled()
    field.fill("so much more of it " * 4)
    expect(note).to_contain_text("too long: it has 21 tokens, and 12 is the most")
    expect(send).to_be_disabled()
    field.fill("  ")
    expect(note).to_contain_text("empty")
    ann.page.reload()
    assert ann.question() == id
    ann.test("draft-reset").click()
    expect(note).to_contain_text("fine as it is")
    ann.page.keyboard.press("Escape")
    ann.press("x")
    ann.saved()
    assert text_house.store.demonstrations() == []
    assert text_house.store.counts()["skipped"] == 1


def test_a_text_that_the_server_refuses_comes_back_to_be_changed(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"), reduced_motion="reduce")
    ann.allowed += ["422", LOST]
    ann.context.route("**/api/drafts", lambda route: route.abort())
    id = ann.question()
    ann.test("draft").fill("so much more of it " * 4)
    ann.test("submit-text").click()
    expect(ann.page.locator(".toast.bad")).to_contain_text("too long")
    ann.question_is(id)
    expect(ann.test("draft")).to_have_value("so much more of it " * 4)
    ann.test("draft").fill(" and that is that")
    ann.page.keyboard.press("Control+Enter")
    ann.gone(id)
    ann.saved()
    (one,) = text_house.store.demonstrations()
    assert one.like.text == " and that is that"


@pytest.mark.parametrize("house", ["text_house", "clip_house"])
def test_showing_keeps_nobody_out_and_fits_on_a_phone(house: str, visit: Visit, request: pytest.FixtureRequest) -> None:
    served: House = request.getfixturevalue(house)
    for scheme in ("light", "dark"):
        me = visit(served.link("ann"), color_scheme=scheme, reduced_motion="reduce")
        me.question()
        found = Axe().run(me.page).response["violations"]
        assert [one["id"] for one in found if one["impact"] in ("serious", "critical")] == []
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    small = visit(served.link("ann"), reduced_motion="reduce", **phone)
    small.question()
    send = small.test("submit-text" if house == "text_house" else "submit-actions")
    expect(send).to_be_in_viewport(ratio=1)
    expect(small.test("skip")).to_be_in_viewport(ratio=1)
    root = "document.documentElement"
    assert small.page.evaluate(f"[{root}.scrollWidth - innerWidth, {root}.scrollHeight - innerHeight]") == [0, 0]
