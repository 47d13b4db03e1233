"""The page that follows a search: a recorded sequence, in a browser, and of the command."""

import json
import re
from types import SimpleNamespace

import pytest
from browser import chromium
from helpers import command

import tuning
from jaxtank import presets
from tuning.cli.watch import Watch
from tuning.live.watch import Watched, page, ticks

EVIL = "</script><img src=x onerror=alert(1)>"


def event(number, cost, best, **more):
    """An event of a search."""
    details = {
        "parameters": [
            {"name": EVIL, "unit": "-", "low": 0.1, "high": 10.0, "before": 1.0, "now": best}
        ],
        "limits": [
            {"name": "max_level", "unit": "cm", "value": 30.0, "sense": 1.0, "margin": -0.5}
        ],
    }
    return {
        "start": 0,
        "starts": 2,
        "evaluations": number,
        "cost": cost,
        "violation": 0.0,
        "best": best,
        "best_violation": 0.02,
        "unit": "cm",
        "details": lambda: details,
        **more,
    }


@pytest.fixture
def watch(tmp_path):
    """A Watch with a clock that stands until it is moved."""
    now = [0.0]
    found = Watch(tmp_path / "out", SimpleNamespace(name=EVIL, title=EVIL), clock=lambda: now[0])
    found.move = lambda seconds: now.__setitem__(0, seconds)
    return found


def test_a_page_shows_what_a_search_has_found(watch):
    for number, (cost, best) in enumerate([(4.0, 4.0), (2.0, 2.0), (3.0, 2.0)], 1):
        watch.move(2.0 * number)
        watch(event(number, cost, best, stage="search"))
    text = (watch.folder / "watch.html").read_text()
    assert "Running: search, local search 1 of 2" in text and "2 cm" in text
    assert (
        "violated by 2 %" in text and "max_level at most 30 cm" in text and "<td>-0.5</td>" in text
    )
    # of the best: 4 at the first evaluation, 2 at the second and third, as an SVG path
    y = [float(v) for v in re.findall(r'class="best" d="M[\d.]+ ([\d.]+)H[\d.]+V([\d.]+)', text)[0]]
    dots = [float(v) for v in re.findall(r'<circle class="held" cx="[\d.]+" cy="([\d.]+)', text)]
    assert y == dots[:2] and dots[0] < dots[2] < dots[1]
    assert text.count("<script>") == 1 and "<img" not in text and "&lt;img" in text
    script = (watch.folder / "watch.js").read_text()
    given = json.loads(script[script.index("{") : script.rindex("}") + 1])
    assert given["body"] in text and given["title"].endswith(EVIL)


def test_an_ended_search_links_its_report_and_is_not_loaded_again(watch):
    watch(event(1, 4.0, 4.0))
    assert "refresh" in (watch.folder / "watch.html").read_text()
    (watch.folder / "report.html").touch()
    watch.end("ended", ["it converged"], result=True, values={EVIL: 0.7})
    text = (watch.folder / "watch.html").read_text()
    assert "<td>1</td><td>0.7</td><td>4</td>" in text  # the result beside the best of the search
    assert 'href="report.html"' in text and "it converged" in text and "refresh" not in text


def test_a_search_that_fails_or_is_stopped_at_once_says_so(watch):
    with pytest.raises(RuntimeError), watch:
        watch(event(1, 4.0, None))
        (watch.folder / "report.html").touch()  # of an earlier search
        raise RuntimeError
    text = (watch.folder / "watch.html").read_text()
    assert "Stopped without a result" in text and "none yet" in text
    assert "report.html" not in text


def test_pages_are_written_once_a_second_and_a_failure_ends_nothing(watch):
    watch(event(1, 4.0, 4.0))
    watch.move(0.5)
    watch(event(2, 3.0, 3.0))
    assert "4 cm" in (watch.folder / "watch.html").read_text()
    for path in watch.folder.iterdir():
        path.unlink()
    watch.folder.rmdir()
    watch.folder.touch()  # a file in the place of the folder
    watch.move(2.0)
    watch(event(3, 2.0, 2.0))
    watch.end("ended")
    assert watch.folder.is_file()


def test_a_second_search_has_a_line_of_its_own(watch):
    for at, (number, best) in enumerate([(1, 4.0), (2, 3.0), (1, 9.0), (2, 8.0)]):
        watch.move(2.0 * at)
        watch(event(number, best, best))
    text = (watch.folder / "watch.html").read_text()
    assert text.count('class="best"') == 2 and "<dd>4</dd>" in text


def test_numbers_of_an_axis_are_round_and_inside():
    for low, high in ((0.0, 1.0), (0.123, 0.124), (-3.0, 7.0), (1.0, 1e5)):
        found = ticks(low, high, 5)
        assert 2 <= len(found) <= 7 and low <= found[0] and found[-1] <= high * (1 + 1e-12)


def test_a_page_without_an_evaluation_is_whole():
    text = page(Watched("paper/case", "a title", 0.0))
    assert "compiling" in text and "No evaluation is finished yet" in text


def test_an_open_page_follows_the_file_without_a_network(watch):
    with chromium() as browser:
        watch(event(1, 4.0, 4.0))
        context = browser.new_context(offline=True, viewport={"width": 390, "height": 800})
        try:
            faults, tab = [], context.new_page()
            tab.on("console", lambda m: faults.append(m.text))
            tab.on("pageerror", lambda e: faults.append(str(e)))
            tab.goto((watch.folder / "watch.html").as_uri())
            assert "4 cm" in tab.text_content("dl")
            watch.move(2.0)
            watch(event(2, 3.0, 3.0))
            tab.locator("dl", has_text="3 cm").wait_for(timeout=10_000)
            (watch.folder / "report.html").touch()
            watch.end("ended", result=True)
            tab.locator("text=Report of the result").wait_for(timeout=10_000)
            assert tab.title().startswith("ended 3") and faults == []
            assert tab.evaluate("document.documentElement.scrollWidth") <= 390
            assert tab.evaluate("document.images.length") == 0
        finally:
            context.close()


def test_events_of_a_search_hold_what_the_page_shows(tmp_path):
    case = presets.find("cascaded/pi").replace(limits={"max_level": 9.0})
    watch = Watch(tmp_path, case)
    few = dict(starts=1, screening=2, iterations=2, validation=0)
    free = {"controller.Kc": (0.5, 2.0)}
    found = tuning.tune(case, free=free, nominal=True, progress=watch, **few)
    watch.end("ended")
    text = (tmp_path / "watch.html").read_text()
    after = found["controller.Kc[0]"].after
    assert f"<td>1</td><td>{after:.5g}</td><td>0.5</td><td>2</td>" in text
    margins = [c.margin for c in found.constraints]
    assert "max_level of tank 1 at most 9" in text
    assert all(f"<td>{margin:.4g}</td>" in text for margin in margins)


def test_the_page_needs_a_folder():
    done = command("tune", "cascaded/pi", "--watch", "--nominal")
    assert done.code == 2 and "--out DIR" in done.err and done.err.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["--nominal", "--robust=mean", "--seed=0"])
def test_the_command_writes_the_page(tmp_path, kind):
    words = [kind, "--watch", "--starts", "1", "--iterations", "2", "--limit", "none"]
    words += ["--free", "controller.Kc=0.5:2", "--out", str(tmp_path)]
    done = command("tune", "cascaded/pi", *words)
    text = (tmp_path / "watch.html").read_text()
    assert done.code in (0, 3) and "watch.html follows the search" in done.err
    assert 'href="report.html"' in text and "controller.Kc[0]" in text and "Ended" in text
    found = json.loads((tmp_path / "result.json").read_text())["parameters"]["controller.Kc[0]"]
    assert f"<td>1</td><td>{found['after']:.5g}</td>" in text and re.search(r" s\)</p>", text)
