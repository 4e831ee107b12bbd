"""When the server, the network or the tab goes away: nothing is called saved before it is, and nothing is lost."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser.child import Start, free_port, serve_command
from browser.house import House, clips, fill
from browser.visitor import LOST, Visit, Visitor
from playwright.sync_api import APIResponse, Browser, Route, expect

from prefrl.store import Store
from prefrl.types import Segment

pytestmark = pytest.mark.browser
FOLLOW = """() => {
  window.states = [];
  const button = document.querySelector("[data-testid=save-state]");
  const note = () => window.states.push(button.dataset.state);
  new MutationObserver(note).observe(button, { attributes: true, attributeFilter: ["data-state"] });
}"""


def states(visitor: Visitor) -> list[str]:
    """What the page said of its answers since `FOLLOW`."""
    return [str(one) for one in visitor.page.evaluate("window.states")]


def test_saved_is_said_only_after_the_receipt(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    ann.question()
    held: list[Route] = []
    ann.context.route("**/api/answers", lambda route: held.append(route))
    ann.page.evaluate(FOLLOW)
    ann.press("1")
    ann.press("2")
    ann.question()
    assert set(states(ann)) == {"saving"}
    assert text_house.spoken() == 0
    for route in held:
        route.continue_()
    ann.context.unroute("**/api/answers")
    ann.saved()
    assert text_house.spoken() == 2


def test_answers_given_offline_arrive_when_the_connection_is_back(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    ann.allowed.append(LOST)
    ann.press_and_refill("1")
    ann.context.set_offline(True)
    ann.page.evaluate(FOLLOW)
    given = [ann.press(key) for key in ("1", "s", "0", "x", "2", "1")]
    ann.situation("offline")
    expect(ann.test("save-state")).to_contain_text("6 unsent")
    expect(ann.test("banner")).to_contain_text("No connection")
    assert "saved" not in states(ann)
    assert text_house.spoken() == 1
    ann.context.set_offline(False)
    ann.saved()
    assert text_house.spoken() == 7
    assert set(map(text_house.query_of, given)) < set(text_house.answers())
    ann.press("1")


def test_undo_works_offline_too(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    ann.allowed.append(LOST)
    ann.press_and_refill("1")
    ann.context.set_offline(True)
    kept, taken = ann.press("2"), ann.press("1")
    ann.page.keyboard.press("z")
    ann.question_is(taken)
    ann.press("0")
    ann.context.set_offline(False)
    ann.saved()
    assert text_house.preference(text_house.query_of(taken)) == 0.5
    assert text_house.query_of(kept) in text_house.answers()


def test_unsent_answers_outlive_the_tab(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    ann.allowed.append(LOST)
    ann.press_and_refill("1")
    ann.context.set_offline(True)
    ann.press("2")
    ann.press("0")
    expect(ann.test("save-state")).to_contain_text("2 unsent")
    ann.page.close(run_before_unload=True)
    ann.context.set_offline(False)
    again = ann.window(f"{text_house.origin}/label")
    again.saved()
    assert ann.held_back == 1
    assert text_house.spoken() == 3


def test_a_question_whose_answer_overtakes_the_next_fetch_is_not_shown_again(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    ann.allowed.append(LOST)
    ann.question()
    answers: list[Route] = []
    fetches: list[tuple[Route, APIResponse]] = []
    ann.context.route("**/api/answers", lambda route: answers.append(route))
    answered = ann.press("1")
    ann.question()
    answers.clear()
    ann.context.route("**/api/assignments", lambda route: fetches.append((route, route.fetch())), times=1)
    ann.page.reload()
    while not (answers and fetches):
        ann.page.wait_for_timeout(50)
    answers[0].continue_()
    ann.saved()
    route, response = fetches[0]
    assert answered in response.text()
    route.fulfill(response=response)
    assert ann.question() != answered


def test_the_back_button_leaves_one_answer_to_each_question(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    ann.allowed.append(LOST)
    given = [ann.press("1")]
    ann.saved()
    ann.go("/history")
    expect(ann.test("entry")).to_have_count(1)
    ann.page.go_back()
    given.append(ann.press("2"))
    ann.page.go_forward()
    expect(ann.test("entries")).to_be_visible()
    ann.page.go_back()
    ann.question()
    ann.context.route("**/api/answers", lambda route: route.abort())
    given.append(ann.press("0"))
    expect(ann.test("save-state")).to_have_attribute("data-state", "offline")
    ann.page.goto("about:blank")
    ann.context.unroute("**/api/answers")
    ann.page.go_back()
    ann.saved()
    given.append(ann.press("1"))
    ann.saved()
    assert len(set(given)) == 4
    assert text_house.spoken() == 4
    assert set(map(text_house.query_of, given)) == set(text_house.answers())


def test_who_was_signed_out_sends_what_is_unsent_with_the_next_link(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    ann.allowed += [LOST, "401"]
    ann.question()
    ann.context.route("**/api/answers", lambda route: route.abort())
    ann.press("1")
    ann.context.clear_cookies()
    ann.context.unroute("**/api/answers")
    expect(ann.test("welcome")).to_contain_text("1 answer is still kept")
    assert text_house.spoken() == 0
    ann.page.goto(text_house.link("ann"))
    ann.saved()
    assert text_house.spoken() == 1


def test_a_server_killed_before_its_receipt_holds_the_label_once(
    tmp_path: Path, chromium: Browser, visit: Visit, start: Start
) -> None:
    folder, port = fill(tmp_path / "clips", clips(3)), free_port()
    server = start(*serve_command(folder, port))
    waiting = chromium.new_page()
    me = visit(server.link(waiting))
    me.allowed.append(LOST)
    me.go("/label")

    def kill(route: Route) -> None:
        route.fetch()  # the label is on disk: this returns with its receipt
        server.kill()
        route.abort()

    me.question()
    me.context.route("**/api/answers", kill, times=1)
    me.press("1")
    expect(me.test("save-state")).to_have_attribute("data-state", "offline")
    again = start(*serve_command(folder, port))
    again.link(waiting)
    waiting.close()
    me.saved()
    me.press("2")
    me.saved()
    again.kill()
    with Store[Segment](folder, write=False) as store:
        assert sum(one["kind"] == "comparison" for one in store.events()) == 2
        assert len(store.answers()) == 2
