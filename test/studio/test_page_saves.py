"""The page saves typed numbers and fast key presses, and handles late server states."""

from __future__ import annotations

import json
import math

import pytest
from labeling_pages import get_boxes, open_page

pytestmark = pytest.mark.no_cover  # covered by other tests


def test_typed_number_changes_one_value_unless_cancelled(page, labels, person):
    number = labels.add_track(page, person)
    page.click("[data-filter=all]")
    before, lines = labels.box(number), len(labels.lines())
    for key, text, there in (
        ("Enter", "", before),
        ("Enter", "1e99", before),
        ("Escape", "4.5", before),
        ("Enter", "4.567", [before[0], 4.567]),
    ):
        page.click(f"#tracks [data-track='{number}']")
        page.click("#field-y", click_count=3)
        page.keyboard.press("Delete")
        page.keyboard.type(text)
        page.keyboard.press(key)
        labels.wait(page, number, lambda t, y=there[1]: get_boxes(t)[0][1] == y)
        page.wait_for_function("y => document.getElementById('field-y').value === y", arg=f"{there[1]:.2f}")
    page.click("#errors .toast button")  # the rejection was reported
    assert labels.box(number) == [before[0], 4.567, *before[2:]]
    assert len(labels.lines()) == lines + 1
    page.focus("#field-x")
    for text in "3.25", "2.125":  # the second before the first is saved
        page.keyboard.press("Control+a")
        page.keyboard.type(text)
        page.keyboard.press("Tab")
    labels.wait(page, number, lambda t: get_boxes(t)[0][:2] == [3.25, 2.125])


def test_keys_apply_to_the_shown_frame_while_another_loads(browser, page, labels, person):
    number = labels.add_track(page, person)
    before, held = labels.box(number), []
    with open_page(browser, f"{labels.url}&track={number}") as other:
        other.route("**/api/cloud/7*", lambda route: held.append(route))
        other.keyboard.press("End")
        other.keyboard.down("ArrowUp")
        other.wait_for_function("() => page.store.draft")
        while not held:
            other.wait_for_timeout(10)
        held.pop().continue_()
        other.wait_for_function("() => page.store.frame === 7")
        other.keyboard.up("ArrowUp")
        labels.wait(other, number, lambda t: get_boxes(t)[0] != before)
    assert math.dist(labels.box(number)[:2], before[:2]) == pytest.approx(0.05)


def test_each_frame_is_checked_once_at_any_typing_speed(browser, page, labels):
    with open_page(browser, labels.url) as other:
        held = []
        other.route("**/api/cloud/4*", lambda route: held.append(route))
        for _ in range(3):
            other.keyboard.press(".")
        other.wait_for_function("() => page.store.frame === 3")
        other.keyboard.press("k")
        other.wait_for_function("() => page.store.requestedFrame === 4")
        other.keyboard.press("k")  # frame 4 is not shown yet
        while not held:
            other.wait_for_timeout(10)
        held.pop().continue_()
        other.wait_for_function("() => page.store.frame === 4")
        other.keyboard.press("k")
        other.wait_for_function("() => page.store.frame === 5")
        assert labels.state()["checked"] == [3, 4]
        for _ in range(2):
            other.keyboard.press("Control+z")
        other.wait_for_function("() => page.store.checked.size === 0")


def test_arrow_key_moves_the_box_after_class_selection(page, labels, person):
    number = labels.add_track(page, person)
    before = labels.box(number)
    page.click("#class")
    for key in "ArrowDown", "Enter":  # in the opened list
        page.keyboard.press(key)
    labels.wait(page, number, lambda t: t["class"] != "Pedestrian")
    new_class = labels.tracks()[number]["class"]
    page.keyboard.press("ArrowUp")
    labels.wait(page, number, lambda t: get_boxes(t)[0] != before)
    assert labels.tracks()[number]["class"] == new_class
    page.route("**/api/do*", lambda route: route.abort())
    page.select_option("#class", "Car")
    page.wait_for_selector("#errors .toast")
    page.wait_for_function("c => document.getElementById('class').value === c", arg=new_class)
    page.unroute("**/api/do*")
    page.click("#errors .toast button")


def test_outdated_server_state_does_not_revert_edits(browser, page, labels, person):
    number, states = labels.add_track(page, person), []

    def reply(route):
        states.append((route, route.fetch()))
        if len(states) == 1:
            route.fulfill(response=states[0][1])

    def hold_state(page):
        page.route("**/api/state*", reply)

    with open_page(browser, labels.url, hold_state) as other:
        while len(states) < 2:  # one when the page opens, one when it subscribes
            other.wait_for_timeout(10)
        page.keyboard.press("3")
        name = page.evaluate("page.store.drive.classes[2].name")
        same = "([n, c]) => page.store.tracks.get(n).class === c"
        other.wait_for_function(same, arg=[number, name])
        with other.expect_response("**/api/state*"):
            states[1][0].fulfill(response=states[1][1])
        other.keyboard.press(".")
        other.wait_for_function("() => page.store.frame === 1")
        assert other.evaluate(same, [number, name])


def test_browser_confirms_leaving_with_unsaved_actions(browser, labels):
    held, requests = [], []
    with open_page(browser, labels.url) as other:
        other.route("**/api/do*", lambda route: held.append(route))
        other.on("dialog", lambda dialog: (requests.append(dialog.type), dialog.dismiss()))
        other.keyboard.press("k")
        while not held:
            other.wait_for_timeout(10)
        other.close(run_before_unload=True)
        held.pop().continue_()
        other.wait_for_function("() => page.store.checked.size === 1 && page.store.frame === 1")
        assert requests == ["beforeunload"]
        other.unroute("**/api/do*")
        other.keyboard.press("Control+z")
        other.wait_for_function("() => page.store.checked.size === 0")


def test_export_waits_for_actions_that_are_saved_slowly(page, labels, person):
    number, held = labels.add_track(page, person), []
    before = labels.box(number)
    page.route("**/api/do*", lambda route: held.append(route))
    page.keyboard.press("Shift+ArrowUp")
    while not held:
        page.wait_for_timeout(10)
    page.click("#export")
    page.select_option("#export-format", "sustech")
    page.click("#export-form button.primary")
    held.pop().continue_()
    page.wait_for_selector("#export-dialog", state="hidden")
    page.unroute("**/api/do*")
    written = json.loads(min((labels.out / "labels").iterdir()).read_text())
    heights = {each["obj_id"]: each["psr"]["position"]["z"] for each in written}
    assert heights[str(number)] == labels.box(number)[2] > before[2]


def test_saved_action_without_event_is_not_reported_as_lost(browser, labels):
    def deaf(page):
        page.add_init_script("WebSocket = class {}")

    lines = len(labels.lines())
    with open_page(browser, labels.url, deaf) as other:
        other.route("**/api/state*", lambda route: route.abort())
        other.keyboard.press("k")
        other.wait_for_function("() => page.store.frame === 1")
        assert other.locator("#errors .toast", has_text="Not saved").count() == 0
    assert [line["do"] for line in labels.lines()[lines:]] == ["check"]
