"""A headless Chromium that tells what it sees; spoken to through a pipe, so that nothing else is needed."""

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PATIENCE = 60.0


def executable():
    """Return the path of a browser, or None."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


def kept(browser, name):
    """Write a picture of the whole page into the folder of the variable OPTLOC_SCREENSHOTS, if there is one."""
    if folder := os.environ.get("OPTLOC_SCREENSHOTS"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        browser.picture(Path(folder) / f"{name}.png", whole=True)


class Browser:
    """One browser with one tab; `messages` are its complaints: console errors, exceptions, requests to a network."""

    def __init__(self):
        self.messages, self.requests, self.events, self._number = [], [], [], 0
        self._profile = tempfile.mkdtemp(prefix="optloc-browser-")
        there, self._to = os.pipe()
        self._from, back = os.pipe()
        flags = "--headless --no-sandbox --disable-gpu --disable-dev-shm-usage --remote-debugging-pipe --mute-audio "
        flags += "--disable-background-networking --disable-component-update --no-first-run --hide-scrollbars"
        # The browser reads at descriptor 3 and writes at 4.
        line = f'exec "$0" "$@" 3<&{there} 4>&{back}'
        command = ["bash", "-c", line, executable(), *flags.split(), f"--user-data-dir={self._profile}", "about:blank"]
        quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen(command, pass_fds=(there, back), **quiet)
        os.close(there)
        os.close(back)
        os.set_blocking(self._from, False)
        self._rest, self._session = b"", None
        targets = self.ask("Target.getTargets")["targetInfos"]
        target = next(t["targetId"] for t in targets if t["type"] == "page")
        self._session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        os.close(self._to)
        os.close(self._from)
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(10)
        shutil.rmtree(self._profile, ignore_errors=True)

    def ask(self, method, **arguments):
        """Return the answer to a command of the DevTools protocol."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": arguments}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        number, end = self._number, time.monotonic() + PATIENCE
        while time.monotonic() < end:
            answer = next((a for a in self._received() if a.get("id") == number), None)
            if answer is not None:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]
        raise TimeoutError(method)

    def _received(self):
        """Return the messages that have come; all of them are noted, whichever is waited for."""
        try:
            more = os.read(self._from, 1 << 20)
        except BlockingIOError:
            time.sleep(0.005)
            return []
        assert more, "the browser ended"
        *whole, self._rest = (self._rest + more).split(b"\0")
        messages = [json.loads(text) for text in whole]
        for message in messages:
            self._note(message.get("method"), message.get("params", {}))
        return messages

    def _note(self, method, what):
        if method is not None:
            self.events.append(method)
        if method == "Runtime.exceptionThrown":
            self.messages.append(what["exceptionDetails"].get("exception", {}).get("description", "exception"))
        elif method == "Runtime.consoleAPICalled" and what["type"] in {"error", "warning", "assert"}:
            self.messages.append(str([a.get("value") for a in what["args"]]))
        elif method == "Log.entryAdded" and what["entry"]["level"] in {"error", "warning"}:
            self.messages.append(what["entry"]["text"])
        elif method == "Network.requestWillBeSent" and not what["request"]["url"].startswith("data:"):
            self.requests.append(what["request"]["url"])

    def open(self, path, width=1280, height=900, *, phone=False, dark=False, scripts=True):
        """Open a file or an address and wait until it is loaded; without `scripts`, the page runs none of its own."""
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=phone)
        theme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.ask("Emulation.setEmulatedMedia", features=[theme])
        self.ask("Emulation.setScriptExecutionDisabled", value=not scripts)
        self.events.clear()
        url = path if str(path).startswith("http") else Path(path).resolve().as_uri()
        self.ask("Page.navigate", url=url)
        end = time.monotonic() + PATIENCE
        while "Page.loadEventFired" not in self.events:
            assert time.monotonic() < end, "the page does not load"
            self.run("0")

    def run(self, script):
        """Return the value of a JavaScript expression."""
        found = self.ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def picture(self, path, *, whole=False):
        """Write a picture of the window, or of the whole page."""
        data = self.ask("Page.captureScreenshot", format="png", captureBeyondViewport=whole)["data"]
        Path(path).write_bytes(base64.b64decode(data))

    def pdf(self):
        """Return the page as it is printed."""
        return base64.b64decode(self.ask("Page.printToPDF", printBackground=True)["data"])


# Texts that a reader sees: size on the screen with the scale of the drawing, texts that are wider than their box, and
# labels of the map that cover each other.
TOO_SMALL = """(() => {
  const seen = e => e.textContent.trim() && e.checkVisibility({ visibilityProperty: true }) && !e.children.length;
  const scale = e => e.tagName === 'text' ? e.getScreenCTM().a : 1;
  const size = e => parseFloat(getComputedStyle(e).fontSize) * scale(e);
  const parts = [...document.querySelectorAll('body *')].filter(e => !/^(script|style|title|desc)$/i.test(e.tagName));
  return parts.filter(e => seen(e) && size(e) < 9).map(e => `${e.tagName} ${e.textContent.slice(0, 20)} ${size(e)}`);
})()"""
_CLIPPED = """(() => {
  const parts = document.querySelectorAll('code, .status, .size, .copy, .key li, .layers label, output, p, h1, h2');
  const wide = e => e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display !== 'inline';
  return [...parts].filter(wide).map(e => e.textContent.slice(0, 30));
})()"""
_COVERED = """(() => {
  const labels = [...document.querySelectorAll('.map text:not(.off)')].filter(e => e.checkVisibility());
  const boxes = labels.map(e => e.getBoundingClientRect());
  const meet = (a, b) => a.x < b.right - 2 && b.x < a.right - 2 && a.y < b.bottom - 4 && b.y < a.bottom - 4;
  return boxes.filter((a, i) => boxes.some((b, j) => j < i && meet(a, b))).length;
})()"""


# Two pictures of the screen: a map lays its labels before the second.
_DRAWN = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done())))"


def readable(browser, path, name, ready="true"):
    """Open a page at both widths and in both themes, keep pictures, and check that every text is readable.

    The page is complete when the JavaScript expression `ready` is true.
    """
    for width, phone in ((1280, False), (390, True)):
        for dark in (False, True):
            browser.open(path, width, 844, phone=phone, dark=dark)
            end = time.monotonic() + PATIENCE
            while not browser.run(ready) and time.monotonic() < end:
                time.sleep(0.1)
            browser.run(_DRAWN)
            case = f"{name}-{width}{'-dark' if dark else ''}"
            kept(browser, case)
            assert browser.messages == [], case
            assert browser.run("document.documentElement.scrollWidth") <= width, case
            assert browser.run(TOO_SMALL) == [], case
            assert browser.run(_CLIPPED) == [], case
            assert browser.run(_COVERED) == 0, case
