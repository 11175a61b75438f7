"""The page of label and view in a browser, with the real server."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from labeling_pages import drag, get_boxes, get_centre, get_face_positions, open_page, run_server

from lidar_perception.data.open import open_recording
from lidar_perception.geometry import wrap_angle

pytestmark = pytest.mark.no_cover  # covered by other tests


def test_click_on_a_person_creates_a_track_and_a_seed(page, labels, person):
    seeds = len(labels.state()["seeds"])
    number = labels.seed(page, person)
    state, box = labels.state(), labels.box(number)
    assert len(state["seeds"]) == seeds + 1 and state["seeds"][-1][1] == number
    assert math.dist(box[:2], person[:2]) < 0.6
    assert labels.lines()[-1]["do"] == "seed"
    assert page.inner_text("#who") == f"Track {number}"


def test_seed_can_be_placed_by_keyboard(page, labels, person):
    before = set(labels.tracks())
    labels.look_at(page, person)
    page.locator("#tracks").focus()
    for key in ("Escape", "s", "Enter"):  # picks the centre of the view
        page.keyboard.press(key)
    page.wait_for_function(
        "before => page.store.selected !== null && !before.includes(page.store.selected)", arg=sorted(before)
    )
    box = labels.box(page.evaluate("page.store.selected"))
    assert math.dist(box[:2], person[:2]) < 0.6


def test_keys_accept_reject_and_reopen_and_update_the_progress(page, labels, person):
    number = labels.add_track(page, person)
    for key, state in (("r", "rejected"), ("a", "accepted"), ("u", "proposed")):
        page.keyboard.press(key)
        labels.wait(page, number, lambda t, s=state: t["state"] == s)
        page.wait_for_function("s => document.getElementById('state').textContent === s", arg=state)
        progress = labels.state()["progress"]
        page.wait_for_function(
            "s => document.getElementById('progress-text').textContent.startsWith(s)", arg=f"{progress['left']} open"
        )


def test_all_controls_fit_into_half_a_screen(page, labels, person):
    labels.add_track(page, person)
    viewport_size = page.viewport_size
    page.set_viewport_size({"width": 800, "height": 900})
    parts = "header nav button, #frame-name, #filters button, #numbers input, #actions button"
    outside = page.evaluate(
        """parts => [...document.querySelectorAll(parts)]
        .filter(each => each.getBoundingClientRect().right > innerWidth)
        .map(each => each.id || each.textContent)""",
        parts,
    )
    under = page.evaluate("""() => document.getElementById('timeline').getBoundingClientRect().right
        - document.getElementById('right').getBoundingClientRect().left""")
    page.set_viewport_size(viewport_size)
    assert outside == [] and under < 1


@pytest.mark.parametrize(
    ("selector", "name", "offset"),
    [
        ("[data-view=top]", "+x", (40, 0)),
        ("[data-view=side]", "+z", (0, -25)),
        ("[data-view=front]", "-y", (20, 0)),
        ("#handles", "+z", (0, -40)),
    ],
)
def test_dragging_a_face_moves_only_that_face(page, labels, person, selector, name, offset):
    number = labels.add_track(page, person)
    before = labels.box(number)
    drag(page, get_centre(page, f"{selector} circle[data-handle='{name}']"), offset)
    labels.wait(page, number, lambda t: get_boxes(t)[0] != before)
    old, new = get_face_positions(before), get_face_positions(labels.box(number))
    moved_faces = [face for face in old if not np.allclose(old[face], new[face], atol=1e-6)]
    assert moved_faces == [name], moved_faces
    assert new[name] > old[name]


@pytest.mark.parametrize("key", ["s", "Escape"])
def test_key_hides_the_handles_immediately(page, labels, person, key):
    labels.add_track(page, person)
    page.wait_for_function("() => document.getElementById('handles').style.display === ''")
    assert (
        page.evaluate(
            """async key => {
        document.body.dispatchEvent(new KeyboardEvent('keydown', {key, bubbles: true}));
        for (let k = 0; k < 10; k++) await null; // no picture comes between
        return document.getElementById('handles').style.display;
    }""",
            key,
        )
        == "none"
    )


def test_body_moves_horizontally_and_rotates_about_its_centre(page, labels, person):
    number = labels.add_track(page, person)
    before = labels.box(number)
    drag(page, get_centre(page, "[data-view=top] rect.body"), (30, 10))
    labels.wait(page, number, lambda t: get_boxes(t)[0] != before)
    moved_box = labels.box(number)
    assert moved_box[2:] == pytest.approx(before[2:]) and math.dist(moved_box[:2], before[:2]) > 0.1
    x, y = get_centre(page, "[data-view=top] circle.turn")
    centre = get_centre(page, "[data-view=top]")
    drag(page, (x, y), (centre[0] - x, centre[1] - 60 - y))  # from the right to the top: a quarter turn
    labels.wait(page, number, lambda t: get_boxes(t)[0] != moved_box)
    rotated_box = labels.box(number)
    assert rotated_box[:6] == pytest.approx(moved_box[:6], abs=1e-6)
    assert wrap_angle(rotated_box[6] - moved_box[6]) == pytest.approx(math.pi / 2, abs=0.1)


def test_arrow_keys_move_along_the_box_as_one_action(page, labels, person):
    number = labels.add_track(page, person)
    before, actions = labels.box(number), labels.state()["seq"]
    for _ in range(3):
        page.keyboard.down("ArrowUp")
    page.keyboard.up("ArrowUp")
    labels.wait(page, number, lambda t: get_boxes(t)[0] != before)
    after = labels.box(number)
    step = 0.15 * np.array([math.cos(before[6]), math.sin(before[6])])
    assert np.subtract(after[:2], before[:2]) == pytest.approx(step, abs=1e-6)
    assert labels.state()["seq"] == actions + 1
    page.keyboard.press("Shift+ArrowLeft")
    labels.wait(page, number, lambda t: get_boxes(t)[0] != after)
    assert wrap_angle(labels.box(number)[6] - before[6]) == pytest.approx(math.radians(1))


def test_input_applies_to_the_track_and_frame_at_its_start(page, labels, person):
    other, number = labels.add_track(page, person), labels.add_track(page, person)
    labels.wait(page, other, lambda t: t is not None)
    page.click("[data-filter=all]")
    before = labels.tracks()
    page.fill("#field-y", "4.5")
    page.click(f"[data-track='{other}']")
    labels.wait(page, number, lambda t: get_boxes(t)[0][1] == 4.5)
    assert labels.tracks()[other] == before[other]
    page.keyboard.down("ArrowUp")
    page.keyboard.press(".")
    page.keyboard.up("ArrowUp")
    labels.wait(page, other, lambda t: get_boxes(t)[0] != get_boxes(before[other])[0])
    assert labels.lines()[-1]["frame"] == 0
    page.keyboard.press(",")
    page.wait_for_function("() => page.store.frame === 0")


def test_pressed_row_is_selected_even_if_the_list_changes(page, labels, person):
    other, number = labels.add_track(page, person), labels.add_track(page, person)
    labels.wait(page, other, lambda t: t is not None)
    page.click("[data-filter=all]")
    assert page.evaluate("page.store.selected") == number
    for pressed_number in other, number:
        row = page.locator(f"[data-track='{pressed_number}']").bounding_box()
        page.mouse.move(row["x"] + 30, row["y"] + row["height"] / 2)
        page.mouse.down()
        page.evaluate("document.getElementById('tracks').dispatchEvent(new Event('scroll'))")
        page.mouse.up()
        page.wait_for_function("n => page.store.selected === n", arg=pressed_number)
        page.wait_for_selector(f"[data-track='{pressed_number}'][aria-selected=true]")


def test_small_drag_and_space_key_do_not_change_boxes(page, labels, person):
    number = labels.add_track(page, person)
    lines = len(labels.lines())
    drag(page, get_centre(page, "[data-view=top] rect.body"), (2, 2))
    page.click("[data-do=copy]")  # continues to frame 1
    page.wait_for_function("() => page.store.frame === 1")
    page.keyboard.press("Space")
    page.wait_for_function("() => page.store.playing")
    page.keyboard.press("Space")
    page.wait_for_function("() => !page.store.playing")
    assert [line["do"] for line in labels.lines()[lines:]] == ["copy"]
    assert labels.tracks()[number]["boxes"]


def test_undo_and_redo_step_through_every_state(page, labels, person):
    number = labels.add_track(page, person)
    states = [labels.tracks()]
    for key in ("Shift+ArrowUp", "g", "1", "v"):
        page.keyboard.press(key)
        page.wait_for_function("n => page.store.seq >= n", arg=labels.state()["seq"])
        labels.wait(page, number, lambda t, last=states[-1]: t != last[number])
        states.append(labels.tracks())
    page.keyboard.press(",")  # copying moves to the next frame
    for key, expected in [*(("Control+z", s) for s in states[-2::-1]), *(("Control+y", s) for s in states[1:])]:
        page.keyboard.press(key)
        labels.wait(page, number, lambda t, e=expected: t == e[number])
        assert labels.tracks() == expected
    assert page.locator("#errors .toast").count() == 0


def test_class_of_a_seed_is_chosen_at_the_click(page, labels, person):
    number = labels.add_track(page, person)
    page.keyboard.press("s")
    page.keyboard.press("3")  # class of new tracks, although a track is selected
    name = page.evaluate("page.store.drive.classes[2].name")
    page.wait_for_selector(f"#tool-classes [aria-pressed=true]:has-text('{name}')")
    before = set(labels.tracks())
    labels.look_at(page, person)
    page.keyboard.press("Enter")
    page.wait_for_function(
        "before => page.store.selected !== null && !before.includes(page.store.selected)", arg=sorted(before)
    )
    tracks = labels.tracks()
    assert tracks[page.evaluate("page.store.selected")]["class"] == name
    assert tracks[number]["class"] != name and labels.lines()[-1]["class"] == name
    page.keyboard.press("4")  # the previous class
    page.keyboard.press("Escape")


def test_rejecting_all_undecided_tracks_is_undone_at_once(page, labels, person):
    others = []
    for _ in range(2):
        others.append(number := labels.add_track(page, person))
        page.keyboard.press("u")
        labels.wait(page, number, lambda t: t["state"] == "proposed")
    before, actions = labels.tracks(), labels.state()["seq"]
    page.keyboard.press("Shift+R")
    for number in others:
        labels.wait(page, number, lambda t: t["state"] == "rejected")
    assert labels.state()["seq"] == actions + 1 and labels.state()["progress"]["left"] == 0
    assert page.locator("#reject-rest").is_disabled()
    page.keyboard.press("Control+z")
    labels.wait(page, others[0], lambda t: t["state"] == "proposed")
    assert labels.tracks() == before


def test_edits_appear_on_other_pages(page, browser, labels, person):
    number = labels.add_track(page, person)
    with open_page(browser, labels.url) as other, open_page(browser, labels.url) as third:
        page.keyboard.press("3")
        name = page.evaluate("page.store.drive.classes[2].name")
        for each in (other, third):
            each.wait_for_function("([n, c]) => page.store.tracks.get(n).class === c", arg=[number, name])
        other.wait_for_selector("#notes .toast")
        other.click("#undo")
        page.wait_for_function("([n, c]) => page.store.tracks.get(n).class !== c", arg=[number, name])


def test_unsaved_edit_is_reported_and_reverted(page, labels, person):
    number = labels.add_track(page, person)
    before = labels.tracks()
    page.keyboard.press("x")  # the only frame cannot be trimmed
    page.wait_for_selector("#errors .toast")
    assert labels.tracks() == before and labels.tracks()[number]
    page.fill("#field-length", "-1")
    page.keyboard.press("Enter")
    assert labels.tracks() == before
    page.wait_for_function("() => Number(document.getElementById('field-length').value) > 0")


def test_export_is_written_and_not_overwritten(page, labels, person):
    number = labels.add_track(page, person)
    page.keyboard.press("a")
    labels.wait(page, number, lambda t: t["state"] == "accepted")
    for replace, wrong in ((False, False), (False, True), (True, False)):
        page.click("#export")
        page.select_option("#export-format", "openlabel")
        page.fill("#export-out", "labels.json")
        page.set_checked("#export-force", replace)
        page.click("#export-form button.primary")
        if wrong:
            page.wait_for_function("() => document.getElementById('export-error').textContent")
            page.click("#export-dialog [data-close]")
        else:
            page.wait_for_selector("#export-dialog", state="hidden")
    assert "openlabel" in json.loads((labels.out / "labels.json").read_text())


def test_failed_import_is_shown_in_the_dialog(page, labels):
    page.click("#import")
    page.fill("#import-path", "/nowhere")
    page.click("#import-form button.primary")
    page.wait_for_function("() => document.getElementById('import-error').textContent")
    assert "/nowhere" in page.inner_text("#import-dialog #import-error")
    assert "/nowhere" not in page.inner_text("#errors")


def test_help_lists_the_keys_and_opens_by_keyboard(page):
    page.keyboard.press("?")
    page.wait_for_selector("#help[open]")
    assert "Accept" in page.inner_text("#keys") and "Undo" in page.inner_text("#keys")
    page.keyboard.press("Escape")
    page.wait_for_selector("#help", state="hidden")
    for _ in range(40):  # every command is reachable and has a name
        page.keyboard.press("Tab")
        name = page.evaluate("""() => { const e = document.activeElement;
            return e === document.body ? "-" : e.ariaLabel || e.title || e.textContent.trim()
                || e.labels?.[0]?.textContent; }""")
        assert name, page.evaluate("document.activeElement.outerHTML.slice(0, 200)")


def test_killed_server_loses_no_saved_labels(page, browser, labels, person):
    number = labels.add_track(page, person)
    drag(page, get_centre(page, "[data-view=top] rect.body"), (10, 20))
    page.wait_for_function("() => page.store.draft === null")
    before = labels.tracks()
    labels.process.kill()
    page.wait_for_selector("#lost", state="visible")
    page.keyboard.press("r")
    page.wait_for_selector("#errors .toast")  # not saved, and reported
    with run_server(*labels.arguments) as server:
        labels.process, labels.url = server.process, server.url
        assert labels.tracks() == before and before[number]["state"] != "rejected"
        with open_page(browser, server.url) as second_page:
            assert second_page.evaluate("n => page.store.tracks.has(n)", number)
        page.wait_for_function(
            "() => document.getElementById('lost').textContent.includes('address')"
        )  # it has a new token now


def test_view_shows_labels_and_rejects_actions(browser, drive_bag):
    with run_server("view", drive_bag, "--no-open") as server, open_page(browser, server.url) as page:
        truth = next(iter(open_recording(drive_bag))).truth()
        assert page.evaluate("page.store.results.labels.length") == len(truth)
        assert page.locator("#accept").is_hidden() and page.locator("#export").is_hidden()
        page.click("#play")
        page.wait_for_function("() => page.store.frame >= 2 && page.store.results.frame >= 2")
        reply = json.loads(
            page.evaluate("""async () => (await fetch("/api/do", {method: "POST",
            body: '{"do": "undo"}'})).text()""")
        )
        assert "label" in reply["error"]


def test_view_steps_through_misses_by_key(browser, drive_bag, tmp_path):
    results = tmp_path / "nothing"  # no detections in any frame
    results.mkdir()
    with (
        run_server("view", drive_bag, "--results", results, "--no-open") as server,
        open_page(browser, server.url) as page,
    ):
        missed = page.evaluate("page.store.results.matches.nothing.missed")
        counts = page.evaluate("[...document.querySelectorAll('#counts b')].map(b => Number(b.textContent))")
        assert counts[0] == sum(counts[1:4]) > counts[2] == len(missed) > 0
        assert counts[4] == sum(counts[5:]) == 0
        positions = []
        for k in [*missed, None]:
            page.keyboard.press("n")
            page.wait_for_function(
                "([n, seen]) => page.store.selectedResult?.error === 'missed' && "
                "page.store.selectedResult.frame * 1000 + page.store.selectedResult.k !== seen",
                arg=[k, positions[-1] if positions else -1],
            )
            positions.append(page.evaluate("page.store.selectedResult.frame * 1000 + page.store.selectedResult.k"))
        assert positions[:-1] == missed and positions[-1] >= 1000  # the last one is in the next frame
        assert page.inner_text("#state") == "missed" and page.is_visible("#facts")
        page.keyboard.press("[")
        page.wait_for_function("k => page.store.frame === 0 && page.store.selectedResult?.k === k", arg=missed[-1])
        row = page.evaluate("page.store.selectedResult.row")
        page.keyboard.press("Escape")
        page.wait_for_function("() => page.store.selectedResult === null")
        page.evaluate("b => page.lookAt(b.slice(0, 3), [b[0] - 4, b[1] - 1, b[2] + 3])", row)
        area = page.locator("#scene").bounding_box()
        at = page.evaluate("b => page.project(...b.slice(0, 3))", row)
        page.mouse.click(area["x"] + at[0], area["y"] + at[1])
        page.wait_for_function("k => page.store.selectedResult?.k === k", arg=missed[-1])
        assert page.inner_text("#who") == row[7]
