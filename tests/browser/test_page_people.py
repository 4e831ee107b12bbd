"""People and what an admin does about them, as they see it happen."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser.house import House, Open, fill, texts
from browser.visitor import LOST, Visit
from playwright.sync_api import expect

pytestmark = pytest.mark.browser


def test_the_link_leaves_no_token_in_the_address(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    assert ann.page.url == f"{text_house.origin}/label"
    ann.page.reload()
    ann.question()


def test_who_has_no_link_is_told_how_to_get_one(text_house: House, visit: Visit) -> None:
    nobody = visit(f"{text_house.site.address}#not-a-token", wait=False)
    nobody.allowed.append("401")
    expect(nobody.test("welcome")).to_contain_text("Open the link you were sent")
    nobody.page.goto(text_house.origin)
    expect(nobody.test("welcome")).to_contain_text("Open the link you were sent")


def test_a_link_is_kept_while_the_server_is_too_busy_to_look_at_it(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.origin, wait=False)
    ann.allowed += ["401", "429"]
    busy = {"status": 429, "headers": {"retry-after": "1"}, "json": {"error": "too many requests"}}
    ann.page.route("**/api/session", lambda route: route.fulfill(**busy), times=1)
    ann.page.goto(text_house.link("ann"))
    expect(ann.test("welcome")).to_contain_text("Your link is kept")
    ann.test("retry").click()
    ann.question()


def test_an_admin_invites_somebody_who_labels_in_another_browser(text_house: House, visit: Visit) -> None:
    me = visit(text_house.admin)
    me.go("/admin")
    me.test("invite-name").fill("Zoë")
    me.test("invite").click()
    link = me.page.locator("dialog input").input_value()
    assert link.startswith(text_house.site.address)
    me.page.keyboard.press("Escape")
    zoe = visit(link)
    zoe.press("1")
    zoe.press("0")
    zoe.saved()
    assert len(text_house.answers("Zoë")) == 2
    row = me.test("annotator-Zoë")
    expect(row.locator("td").first).to_have_text("2")
    expect(me.page.locator(".tile-value").first).to_have_text("2 / 24")


def test_annotators_have_no_way_into_the_administration(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    assert ann.page.locator("nav a[data-path='/admin']").count() == 0
    ann.page.goto(f"{text_house.origin}/admin")
    ann.question()
    assert not any("/api/admin" in url for url in ann.requests)


def test_a_paused_person_is_told_and_goes_on_when_let_in_again(text_house: House, visit: Visit) -> None:
    ann, me = visit(text_house.link("ann")), visit(text_house.admin)
    me.go("/admin")
    ann.press("1")
    me.test("pause-ann").click()
    expect(ann.test("banner")).to_contain_text("paused")
    ann.page.reload()
    ann.situation("paused")
    me.test("resume-ann").click()
    ann.press("2")
    ann.saved()
    assert len(text_house.answers()) == 2


def test_a_revoked_person_is_out_and_the_link_is_dead(text_house: House, visit: Visit) -> None:
    link = text_house.link("ann")
    ann, me = visit(link), visit(text_house.admin)
    me.go("/admin")
    ann.allowed.append("401")
    ann.question()
    me.test("revoke-ann").click()
    me.test("revoke-ann").click()
    expect(ann.test("welcome")).to_be_visible(timeout=10_000)
    ann.page.goto(link)
    expect(ann.test("welcome")).to_be_visible()


def test_a_new_guideline_is_put_before_people_at_work(text_house: House, visit: Visit) -> None:
    ann, me = visit(text_house.link("ann")), visit(text_house.admin)
    me.go("/admin")
    ann.press("1")
    for number, notice in enumerate(("before you begin", "has changed")):
        me.test("guideline-edit").fill(f"Look **twice**, {number}.")
        me.test("save-guideline").click()
        expect(ann.test("guideline-dialog")).to_contain_text(notice)
        expect(ann.test("guideline-dialog")).to_contain_text(f"Look twice, {number}.")
        ann.test("guideline-read").click()
    ann.page.reload()
    ann.question()
    assert ann.test("guideline-dialog").count() == 0
    ann.press("1")  # a question that was fetched before the guideline changed
    ann.saved()
    assert text_house.about()[-1]["guideline"] == text_house.service.guideline.version


def test_what_must_be_agreed_to_comes_before_the_first_question_and_once(
    tmp_path: Path, open_house: Open, visit: Visit
) -> None:
    house = open_house(
        fill(tmp_path / "texts", texts(4)), consent="Your answers are **kept**.", guideline="Look twice."
    )
    ann = visit(house.link("ann"))
    expect(ann.test("consent")).to_contain_text("Your answers are kept.")
    ann.page.keyboard.press("1")
    # A disk that does not answer: the page hears how the project stands before it has anything to show.
    ann.page.add_init_script("IDBFactory.prototype.open = () => ({})")
    ann.page.goto(f"{house.origin}/history")
    expect(ann.test("consent")).to_be_visible()
    assert ann.test("guideline-dialog").count() == ann.test("question").count() == 0
    ann.test("agree").click()
    ann.test("guideline-read").click()
    ann.go("/label")
    ann.press("1")
    ann.saved()
    ann.page.reload()
    ann.question()
    assert ann.test("consent").count() == 0
    assert house.service.consent.agreed == {"ann": house.service.consent.version}


def test_a_text_that_must_be_agreed_to_comes_up_while_somebody_is_at_work(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    ann.press("1")
    text_house.service.consent.text, text_house.service.consent.version = "New terms.", "1"
    expect(ann.test("consent")).to_contain_text("New terms.")
    ann.test("agree").click()
    ann.press("2")
    ann.saved()
    assert len(text_house.answers()) == 2


def test_overlap_is_changed_while_people_label(text_house: House, visit: Visit) -> None:
    me = visit(text_house.admin)
    me.go("/admin")
    me.page.locator("[data-testid=overlap]").fill("2")
    me.test("save-overlap").click()
    expect(me.test("toast").first).to_contain_text("Saved")
    assert text_house.service.desk.policy.overlap == 2


def test_an_export_is_downloaded(text_house: House, visit: Visit) -> None:
    ann, me = visit(text_house.link("ann")), visit(text_house.admin)
    me.go("/admin")
    ann.press("1")
    ann.press("0")
    ann.saved()
    with me.page.expect_download() as download:
        me.test("export-preferences").click()
    assert download.value.suggested_filename == "preferences.jsonl"
    assert len(download.value.path().read_text().splitlines()) == 1
    expect(me.test("toast").first).to_contain_text("preferences.jsonl: 1 written. Left out: ")
    expect(me.test("toast").first).to_contain_text("1 × tie")


def test_signing_out_ends_the_session(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    ann.allowed += ["401", LOST]
    ann.question()
    ann.test("settings").click()
    ann.test("sign-out").click()
    expect(ann.test("welcome")).to_be_visible()
    ann.page.goto(f"{text_house.origin}/label")
    expect(ann.test("welcome")).to_be_visible()
