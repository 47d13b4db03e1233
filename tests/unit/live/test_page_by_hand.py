"""What a hand does on the live page: drags, keys of the legend, pins and missions."""

import pytest
from browser import chromium, opened

from jaxtank import presets
from jaxtank.live.engine import facts_of
from jaxtank.live.page import page


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    path = tmp_path_factory.mktemp("live") / "page.html"
    path.write_text(page(presets.find("cascaded/pi")), encoding="utf-8")
    with chromium() as browser, opened(browser, path) as page_open:
        yield page_open


def drag(live, x, y, up):
    live.page.mouse.move(x, y)
    live.page.mouse.down()
    live.page.mouse.move(x, y - up, steps=4)
    live.page.mouse.up()
    live.page.wait_for_timeout(300)


def height_of_line(live, chart, part):
    """Where the pointer turns into that of a drag, at a part of the width of a chart."""
    box = live.page.locator(".u-over").nth(chart).bounding_box()
    x = box["x"] + part * box["width"]
    for dy in range(int(box["height"])):
        live.page.mouse.move(x, box["y"] + dy)
        cursor = live(f"document.querySelectorAll('.u-over')[{chart}].style.cursor")
        if cursor == "ns-resize":
            return x, box["y"] + dy + 3
    raise AssertionError("no line to drag")


def test_a_setpoint_is_dragged_in_its_chart_and_a_rim_in_both_pictures(live):
    live.page.click("#reset")
    x, y = height_of_line(live, 0, 0.5)  # tank 1 is not controlled: its rim
    drag(live, x, y, -20)
    (name, value), *others = live("Object.entries(jaxtank.state().values)")
    assert name == "plant.rim[0]" and 5.0 < value < 10.0 and not others
    live.page.click("#reset")
    before = {
        leaf["name"]: leaf["value"] for leaf in facts_of(presets.find("cascaded/pi"))["leaves"]
    }
    x, y = height_of_line(live, 1, 0.95)
    drag(live, x, y, -15)
    moved = live("Object.entries(jaxtank.state().values)")
    assert len(moved) == 1 and moved[0][0].startswith(("reference.targets", "plant.rim"))
    assert 0.0 < moved[0][1] < before[moved[0][0]]
    assert live("jaxtank.state().shown") == [0, 2800], "a drag of a line is no zoom"
    live.page.click("#reset")
    grip = live.page.locator("rect.grip").first.bounding_box()
    drag(live, grip["x"] + grip["width"] / 2, grip["y"] + grip["height"] / 2, 15)
    (name, value), *others = live("Object.entries(jaxtank.state().values)")
    assert name == "plant.rim[0]" and value > before[name] and not others


def test_pins_say_what_differs_are_read_at_the_cursor_and_hidden_by_their_key(live):
    live.page.click("#reset")
    box = live.page.locator("input[type=number][aria-label^='controller.Kc[0]']")
    box.fill("0.5")
    live.page.click("#pin")
    legend = live.page.locator("#legend")
    assert "Kc of tank 2 0.5" in legend.inner_text()
    name = legend.inner_text().split(":")[0].split()[-2:]  # "run 1"
    assert " ".join(name) in live.text(".panel .reading")
    live.page.locator("button.key.pin0").click()
    assert " ".join(name) not in live.text(".panel .reading")
    assert live.page.locator("button.key.pin0").get_attribute("aria-pressed") == "false"


def test_the_mission_of_a_fault_ends_with_the_button_of_that_fault(live):
    live.page.click("#reset")
    live.page.locator("#missions summary").click()
    live.page.locator("#missions button", has_text="fault").click()
    buttons, ends = live.page.locator("#breaks button"), []
    for k in range(buttons.count()):
        buttons.nth(k).click()
        live.wait("!document.querySelector('#message').textContent.startsWith('Mission')")
        live.page.wait_for_timeout(300)
        ends.append(live.text("#message").startswith("Done: "))
        if ends[-1]:
            break
        buttons.nth(k).click()
        live.page.wait_for_timeout(200)
    assert ends.count(True) == 1 and ends[-1]


def test_numbers_have_names_for_people():
    leaves = facts_of(presets.find("gouta2015/backstepping"))["leaves"]
    words = {leaf["name"]: leaf["label"] for leaf in leaves}
    assert words["plant.drain[1]"] == "outlet of tank 2"
    assert words["reference.targets[3]"] == "setpoint of tank 1 from 470 s"
    assert words["plant.orifice[0]"] == "outlet of tank 3 into tank 1"
    labels = [label for name, label in words.items() if ".model." not in name]
    assert len(set(labels)) == len(labels), "two numbers with one name"
