"""What a hand does on the live page: drags, keys of the legend, pins and missions."""

import numpy as np
import pytest
from browser import opened

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.tree import get_value, with_values
from jaxtank.live.engine import facts_of, program_of
from jaxtank.live.page import live_page
from jaxtank.loop.trajectory import csv

VALVES = """
units = ["cm", "V"]
tank = [
    { name = "T1", area = 100.0, rim = 30.0, level = 8.0 },
    { name = "T2", area = 100.0, rim = 30.0, level = 6.0, drain = 0.1 },
    { name = "T3", area = 60.0, rim = 20.0, level = 5.0, drain = 0.3 },
]
pipe = [{ between = ["T1", "T2"], area = 0.6 }]
orifice = [{ from = "T2", to = "T3", area = 0.2 }]
valve = [
    { name = "HV1", from = "T1", area = 0.5, initial = 0.5 },
    { name = "FV2", from = "T2", area = 0.5, initial = 0.5 },
]
pump = [{ name = "P1", to = "T1", gain = 10.0, high = 12.0, initial = 8.0 }]
plant = { outputs = ["T1", "T2"] }
CONTROLLER
values = { "clock.dt" = 0.5, "clock.duration" = 400.0, "clock.substeps" = 2 }
"""
LOOP = """
reference = { initial = [8.0, 6.0], changes = [[60.0, 1, 9.0]] }
controller = { kind = "pid", Kc = [1.6, -0.1], Ti = 60.0, lead = ["P1", "FV2"] }
"""
BY_HAND = 'controller = { kind = "open-loop", initial = [11.0, 0.3, 0.2] }'


@pytest.fixture(scope="module")
def live(browser, written):
    with opened(browser, written) as page_open:
        yield page_open


def drag(live, x, y, up):
    live.page.mouse.move(x, y)
    live.page.mouse.down()
    live.page.mouse.move(x, y - up, steps=4)
    live.page.mouse.up()
    live.rest()


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


@pytest.mark.extended
def test_a_setpoint_is_dragged_in_its_chart_and_a_rim_in_both_pictures(live):
    live.page.click("#reset")
    x, y = height_of_line(live, 0, 0.5)  # tank 1 is not controlled: its rim
    drag(live, x, y, -20)
    (name, value), *others = live("Object.entries(jaxtank.state().values)")
    assert name == "plant.rim[0]" and 5.0 < value < 10.0 and not others
    live.page.click("#reset")
    case = presets.find("cascaded/pi")
    leaves = facts_of(case, [program_of(case)])["leaves"]
    before = {leaf["name"]: leaf["value"] for leaf in leaves}
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


def openings(live):
    """{valve: opening in %} of the drawing."""
    words = live.page.locator("#rig text.small").all_text_contents()
    return {word.split()[0]: float(word.split()[1]) for word in words if word.endswith("%")}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("control", "by_hand"),
    [(LOOP, {"HV1"}), (BY_HAND, {"HV1", "FV2"})],
    ids=["closed loop", "open loop"],
)
def test_outlets_pipes_and_valves_of_a_custom_rig_are_dragged(browser, tmp_path, control, by_hand):
    """A valve that a controller moves shows its opening at the cursor and is no handle."""
    case = rig.loads(VALVES.replace("CONTROLLER", control))
    path = live_page(case).save(tmp_path / "page.html")
    with opened(browser, path) as live:
        _, *valves = map(float, 100 * jaxtank.simulate(case.loop, case.clock).u[-1])
        assert openings(live) == pytest.approx(dict(zip(["HV1", "FV2"], valves)), rel=6e-3)
        handles = live.page.locator("#rig polyline.handle")
        names = [title.removesuffix(": drag up or down") for title in handles.all_text_contents()]
        fixed = {"pipe between T1 and T2", "outlet of T2 into T3", "outlet of T2", "outlet of T3"}
        assert fixed < set(names) and len(names) == 4 + len(by_hand)
        moved = {name for name in ("HV1", "FV2") if any(n.endswith(name) for n in names)}
        assert moved == by_hand and live.page.is_visible("#tune") == (control is LOOP)
        for handle, name in enumerate(names):
            where = live(
                "(k) => { const line = document.querySelectorAll('#rig polyline.handle')[k];"
                "const { x, y } = line.getPointAtLength(line.getTotalLength() * 0.9);"
                "const at = new DOMPoint(x, y).matrixTransform(line.getScreenCTM());"
                "return [at.x, at.y]; }",
                handle,
            )
            live.page.click("#reset")
            drag(live, *where, 8)
            ((leaf, value),) = live("Object.entries(jaxtank.state().values)")
            box = live.page.locator(f"input.number[aria-label^='{leaf}']")
            before = float(np.asarray(get_value(case.loop, leaf)))
            assert value > before and float(box.input_value()) == pytest.approx(value), name
            label = live.page.locator(f".row[data-leaf='{leaf}'] label").first.text_content()
            assert label.startswith(name)
            run = jaxtank.simulate(with_values(case.loop, {leaf: value}), case.clock)
            live.rest()
            levels = live.page.locator("#rig .value").all_text_contents()
            np.testing.assert_allclose([float(text.split()[0]) for text in levels], run.x[-1],
                                       rtol=6e-3)  # fmt: skip
            head, low, high = "highest level of T2", *np.sort(run.x[:, 1])[[0, -1]]
            row = live.page.locator("#margins tr", has_text=head).inner_text()
            assert float(row.split()[-2]) == pytest.approx(high, rel=1e-3) and low < high


def test_pins_say_what_differs_are_read_at_the_cursor_and_hidden_by_their_key(live):
    live.page.click("#reset")
    box = live.page.locator("input.number[aria-label^='controller.Kc[0]']")
    box.fill("0.5")
    live.page.click("#pin")
    legend = live.page.locator("#legend")
    assert "Kc of tank 2 0.5" in legend.inner_text()
    name = legend.inner_text().split(":")[0].split()[-2:]  # "run 1"
    assert " ".join(name) in live.text(".panel .reading")
    live.page.locator("button.key.pin0").click()
    assert " ".join(name) not in live.text(".panel .reading")
    assert live.page.locator("button.key.pin0").get_attribute("aria-pressed") == "false"


def at_cursors(live):
    """{row of the table of cursors: its numbers}."""
    rows = live("[...document.querySelectorAll('#cursors tbody tr')].map((row) => "
                "[...row.cells].map((cell) => cell.textContent))")  # fmt: skip
    return {head: [float(number) for number in numbers] for head, *numbers in rows}


def of_library(times, values=()):
    """What the table of cursors must hold, by a simulation of the library."""
    case = presets.find("cascaded/pi")
    run = jaxtank.simulate(with_values(case.loop, dict(values)), case.clock)
    k = np.searchsorted(np.asarray(run.t), np.asarray(times) - 1e-6)
    columns = [run.x[k, 0], run.x[k, 1], run.r[k, 0], run.u[k, 0]]
    return [[*map(float, column), float(column[1] - column[0])] for column in columns]


@pytest.mark.extended
def test_two_cursors_read_every_line_that_is_shown_and_their_difference(live):
    live.page.click("#reset")
    chart = live.page.locator(".u-over").nth(1).bounding_box()
    width, y = chart["width"], chart["y"] + chart["height"] / 2
    live.page.mouse.click(chart["x"] + 0.3 * width, y)
    assert list(at_cursors(live)) == ["time [s]", "tank 1 [V]", "tank 2 [V]",
                                      "tank 2, setpoint [V]", "pump 1 [V]"]  # fmt: skip
    live.page.keyboard.down("Shift")
    live.page.mouse.click(chart["x"] + 0.75 * width, y)
    live.page.keyboard.up("Shift")
    read = at_cursors(live)
    first, second, between = read.pop("time [s]")
    np.testing.assert_allclose([first, second, between], [840, 2100, 1260], atol=8.0)
    np.testing.assert_allclose(list(read.values()), of_library([first, second]), rtol=6e-4)
    assert live("jaxtank.state().shown") == [0, 2800], "a click is no zoom"
    # of the run that is shown, with the pin beside it, and without what the legend hides
    live.page.click("#pin")
    box = live.page.locator("input.number[aria-label^='controller.Kc[0]']")
    box.fill("0.5")
    live.rest()
    now = at_cursors(live)
    pinned = [now.pop(head) for head in list(now) if ", run" in head]
    expected = of_library([first, second], {"controller.Kc": [0.5]})
    np.testing.assert_allclose([*now.values()][1:], expected, rtol=6e-4)
    np.testing.assert_allclose(pinned, np.delete(list(read.values()), 2, axis=0), rtol=1e-9)
    live.page.locator("button.key.setpoint").click()
    live.page.locator("button.key.pin0").click()
    assert [head for head in at_cursors(live) if "," in head] == []
    live.page.locator("button.key.setpoint").click()
    # two clicks show the whole run and set no cursor; Escape takes both away
    live.page.mouse.dblclick(chart["x"] + 0.5 * width, y)
    assert at_cursors(live)["time [s]"] == [first, second, between]
    live.page.keyboard.press("Escape")
    assert at_cursors(live) == {}


@pytest.mark.extended
def test_cursors_are_set_by_keyboard_and_by_a_finger_on_a_narrow_page(browser, written):
    options = {"viewport": {"width": 390, "height": 850}, "has_touch": True}
    with opened(browser, written, **options) as live:
        for key, button in (("Home", "a"), ("End", "b")):
            live.page.focus("#time")
            live.page.keyboard.press(key)
            live.page.focus(f"#cursor-{button}")
            live.page.keyboard.press("Enter")
        assert at_cursors(live)["time [s]"] == [0.0, 2800.0, 2800.0]
        assert live("document.documentElement.scrollWidth") <= 390
        live.page.focus("#cursor-a")
        live.page.keyboard.press("Enter")
        assert at_cursors(live)["time [s]"] == [2800.0]
        chart = live.page.locator(".u-over").first.bounding_box()
        where = {"x": chart["x"] + 0.25 * chart["width"], "y": chart["y"] + 40}
        session = live.page.context.new_cdp_session(live.page)
        touch = lambda kind, points: session.send(
            "Input.dispatchTouchEvent", {"type": kind, "touchPoints": points}
        )
        touch("touchStart", [where])
        live.page.wait_for_timeout(700)
        touch("touchEnd", [])
        np.testing.assert_allclose(at_cursors(live)["time [s]"], [700.0], rtol=0.02)
        live.page.wait_for_timeout(600)  # else it is the second of two
        live.page.touchscreen.tap(where["x"] - 20, where["y"])
        live.page.wait_for_timeout(100)
        first, second, _ = at_cursors(live)["time [s]"]
        assert first < second - 50


@pytest.mark.extended
def test_files_of_a_custom_rig_have_its_names_and_its_keys_and_titles_stay(browser, tmp_path):
    text = VALVES.replace("CONTROLLER", LOOP).replace('"T1"', '"north buffer tank LT101"')
    case = rig.loads(text)
    path = live_page(case).save(tmp_path / "page.html")
    with opened(browser, path, accept_downloads=True) as live:
        run = jaxtank.simulate(case.loop, case.clock)
        head = csv(run, case.loop.units).splitlines()[0]
        assert live("jaxtank.csv()").splitlines()[0] == head
        assert (
            live("makeEngine().info.leaves.find((one) => one.name === 'controller.held[1]').unit")
            == "-"
        )
        heights = []
        for _ in range(2):
            with live.page.expect_download() as got:
                live.page.click("#png")
            heights.append(int.from_bytes(got.value.path().read_bytes()[20:24], "big"))
            for _ in range(3):
                live.page.click("#pin")
        assert heights[1] - heights[0] == 3 * 22  # a key for each pin
        widths = "[...document.querySelectorAll('.panel .name')].map((one) => one.clientWidth)"
        assert min(live(widths)) > 20, "a title gives way to readings"
        live.page.focus("#cursor-a")
        live.page.keyboard.press("Enter")
        live.page.emulate_media(media="print")
        assert live("document.querySelector('#cursors').scrollHeight") == live(
            "document.querySelector('#cursors').clientHeight"
        )
        assert not live.page.get_by_label("remove run 1").is_visible()


@pytest.mark.extended
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


@pytest.mark.extended
def test_numbers_have_names_for_people():
    case = presets.find("gouta2015/backstepping")
    leaves = facts_of(case, [program_of(case)])["leaves"]
    words = {leaf["name"]: leaf["label"] for leaf in leaves}
    assert words["plant.drain[1]"] == "outlet of tank 2"
    assert words["reference.targets[3]"] == "setpoint of tank 1 from 470 s"
    assert words["plant.orifice[0]"] == "outlet of tank 3 into tank 1"
    labels = [label for name, label in words.items() if ".model." not in name]
    assert len(set(labels)) == len(labels), "two numbers with one name"


@pytest.mark.extended
def test_a_rim_below_a_limit_over_which_liquid_spills_is_no_good_verdict(browser, tmp_path):
    case = rig.loads("""
    units = ["cm", "V"]
    tank = [{ name = "LT1", area = 100.0, rim = 20.0, drain = 0.5, level = 10.0 }]
    pump = [{ to = 1, gain = 30.0, high = 6.0 }]
    plant = { outputs = [1], overflow = true }
    controller = { kind = "pi", Kc = [1.0], Ti = [10.0] }
    reference = { initial = [10.0], changes = [[50, 1, 14.0]] }
    limits = { max_level = 18.0 }
    values = { "clock.dt" = 0.5, "clock.duration" = 200.0 }
    """)
    path = live_page(case).save(tmp_path / "page.html")
    with opened(browser, path) as live:
        assert live("jaxtank.verdict().good")
        spilled = live("jaxtank.run({'plant.rim[0]': 14.2}).measures.overflow_volume")
        assert np.ravel(spilled)[0] > 1.0
        verdict = live("jaxtank.verdict()")
        assert not verdict["good"] and "spill over the rim of LT1" in verdict["sentence"]
