"""A browser for the tests of live pages, cut off from any network; skips where there is none."""

import contextlib
import shutil

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@contextlib.contextmanager
def chromium():
    """A headless Chromium."""
    sync = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    with sync.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        try:
            yield browser
        finally:
            browser.close()


class Opened:
    """A page that is open, what it has printed, and what it has asked of a network."""

    def __init__(self, context, path, fragment=""):
        self.page = context.new_page()
        self.faults, self.requests = [], []
        self.page.on("console", lambda m: self.faults.append(m.text))
        self.page.on("pageerror", lambda e: self.faults.append(str(e)))
        self.page.on("dialog", lambda d: self.faults.append(d.message) or d.dismiss())
        self.page.on("request", lambda r: self.requests.append(r.url))
        self.page.goto(path.as_uri() + fragment)
        self.wait("window.jaxtank && document.querySelector('#now').textContent")

    def __call__(self, script, argument=None):
        return self.page.evaluate(script, argument)

    def wait(self, script, seconds=20.0):
        """Wait for an expression to be true; the page's policy forbids what playwright does."""
        for _ in range(int(20 * seconds)):
            if self(script):
                return
            self.page.wait_for_timeout(50)
        raise AssertionError(f"never true: {script}; message: {self.text('#message')}")

    def rest(self, least=0.2):
        """Wait until the charts show the run of the sliders, `least` seconds at the least."""
        self.page.wait_for_timeout(1000 * least)
        self.wait("!document.querySelector('#panels.stale')")
        self.page.wait_for_timeout(100)  # a frame is drawn after its run

    def text(self, selector):
        return self.page.text_content(selector)

    @property
    def fetched(self):
        """Addresses asked for, apart from the file itself and what is inside it."""
        return [u for u in self.requests if not u.startswith(("file:", "data:", "blob:"))]


@contextlib.contextmanager
def opened(browser, path, fragment="", script="", **options):
    """An Opened page of a file, after a script; afterwards it must have printed nothing and asked
    for nothing.
    """
    options = {"viewport": {"width": 1400, "height": 900}, **options}
    context = browser.new_context(offline=True, **options)
    if script:
        context.add_init_script(script)
    try:
        found = Opened(context, path, fragment)
        yield found
        assert found.faults == [] and found.fetched == []
    finally:
        context.close()
