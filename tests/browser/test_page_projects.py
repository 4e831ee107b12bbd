"""Several projects in one browser: on different ports of a host, and one after the other at the same address."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser.child import free_port
from browser.house import Open, fill, said, serving, texts
from browser.visitor import LOST, Visit
from playwright.sync_api import expect

pytestmark = pytest.mark.browser


def test_unsent_answers_wait_for_their_own_project_at_the_same_address(tmp_path: Path, visit: Visit) -> None:
    port = free_port()
    one, other = fill(tmp_path / "one", texts(3)), fill(tmp_path / "other", [said("Another", "a", "b")])
    with serving(one, port=port) as house:
        ann = visit(house.link("ann"))
        ann.allowed.append(LOST)
        ann.question()
        ann.context.set_offline(True)
        ann.press("1")
        expect(ann.test("save-state")).to_have_attribute("data-state", "offline")
        ann.page.close(run_before_unload=True)
    ann.context.set_offline(False)
    with serving(other, port=port) as house:
        there = ann.window(house.link("ann"))
        there.question()
        there.page.wait_for_timeout(1500)
        expect(there.test("save-state")).to_have_attribute("data-state", "idle")
        there.press("2")
        there.saved()
        there.page.close()
        assert house.spoken() == 1
    with serving(one, port=port) as house:
        back = ann.window(f"{house.origin}/label")
        back.saved()
        assert house.spoken() == 1
        back.page.close()


def test_two_projects_of_one_host_are_open_side_by_side(tmp_path: Path, open_house: Open, visit: Visit) -> None:
    one, other = (open_house(fill(tmp_path / name, texts(3))) for name in ("one", "other"))
    ann = visit(one.link("ann"))
    ann.press("1")
    there = ann.window(other.link("ann"))
    there.press("2")
    there.saved()
    ann.page.bring_to_front()
    ann.press("1")
    ann.saved()
    ann.page.reload()
    ann.question()
    assert (one.spoken(), other.spoken()) == (2, 1)
