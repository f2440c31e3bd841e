"""A headless Chromium that opens a page from disk, records what it complains about, and does what a user does.

It is driven over two pipes with Chromium's DevTools protocol, so nothing but the browser itself is needed.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium-headless-shell", "chromium", "google-chrome")
PATIENCE_S = 60.0
"""Longest wait for an answer, also on a slow and busy machine."""


def needed() -> str:
    """Path of the browser; the test is skipped if there is none."""
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip("this test needs a headless Chromium; CONTRIBUTING.md says how to get it")
    return found


class PageLeftError(Exception):
    """The page was left while one of its scripts was asked for a value."""


class Page:
    """A page that is open in the browser."""

    def __init__(self, to_browser: int, from_browser: int) -> None:
        self._out, self._in = to_browser, from_browser
        self._rest, self._number, self._session = b"", 0, ""
        self.complaints: list[str] = []
        """Errors and warnings of the page's scripts, and refused requests."""
        self.requests: list[str] = []
        """Addresses of everything that was requested, except the pages themselves."""

    def attach(self) -> None:
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Result of a command of the protocol. Raises PageLeftError if the page gave way to another meanwhile."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        os.write(
            self._out, json.dumps(message | ({"sessionId": self._session} if self._session else {})).encode() + b"\0"
        )
        while True:
            answer = self._receive()
            if answer.get("id") == self._number:
                if re.search("navigated|context", answer.get("error", {}).get("message", "")):
                    raise PageLeftError
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]

    def _receive(self) -> dict[str, Any]:
        end = time.monotonic() + PATIENCE_S
        while b"\0" not in self._rest:
            assert time.monotonic() < end, "the browser does not answer"
            data = os.read(self._in, 1 << 20)
            assert data, "the browser has ended"
            self._rest += data
        text, _, self._rest = self._rest.partition(b"\0")
        message = json.loads(text)
        match message.get("method"):
            case "Runtime.exceptionThrown":
                self.complaints.append(json.dumps(message["params"]["exceptionDetails"]))
            case "Runtime.consoleAPICalled" if message["params"]["type"] in ("error", "warning", "assert"):
                self.complaints.append(json.dumps(message["params"]["args"]))
            case "Log.entryAdded" if "GPU stall due to ReadPixels" in message["params"]["entry"]["text"]:
                pass  # a screenshot reads pixels
            case "Log.entryAdded" if message["params"]["entry"]["level"] in ("error", "warning"):
                self.complaints.append(message["params"]["entry"]["text"])
            case "Network.requestWillBeSent":
                self.requests.append(message["params"]["request"]["url"])
        return message

    def open(self, page: Path | str, width: int = 1280, *, dark: bool = False) -> None:
        """Open a file, or an address of this machine, and wait until its scripts have run."""
        height = 900 if width > 600 else 800
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])
        address = page if isinstance(page, str) else page.absolute().as_uri()
        self.send("Page.navigate", url=address)
        self.until(f"document.readyState === 'complete' && location.href === {json.dumps(address)}")
        self.requests = [one for one in self.requests if one != address and not one.startswith("data:")]

    def without_webgl(self) -> None:
        """Have pages that are opened from now on find no WebGL."""
        script = (
            "const own = HTMLCanvasElement.prototype.getContext; HTMLCanvasElement.prototype.getContext = "
            "function (kind, ...more) { return kind.startsWith('webgl') ? null : own.call(this, kind, ...more); };"
        )
        self.send("Page.addScriptToEvaluateOnNewDocument", source=script)

    def value(self, script: str) -> Any:
        """Value of a JavaScript expression in the page."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, script: str) -> None:
        """Wait until an expression is true, in this page or in the one that takes its place."""
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            with contextlib.suppress(PageLeftError):
                if self.value(script):
                    return
            time.sleep(0.05)
        raise AssertionError(f"this did not become true: {script}")

    def place(self, selector: str, x: float = 0.5, y: float = 0.5) -> tuple[float, float]:
        """Pixels of a place in an element, as shares of its width and height, after scrolling to it."""
        script = """(() => {
            const found = document.querySelector(SELECTOR);
            found.scrollIntoView({block: "center"});
            const box = found.getBoundingClientRect();
            return [box.left, box.top, box.width, box.height];
        })()"""
        left, top, width, height = self.value(script.replace("SELECTOR", json.dumps(selector)))
        return left + x * width, top + y * height

    def move(self, selector: str, x: float = 0.5, y: float = 0.5) -> None:
        """Move the pointer to a place in an element."""
        across, down = self.place(selector, x, y)
        self.send("Input.dispatchMouseEvent", type="mouseMoved", x=across, y=down)

    def click(self, selector: str, x: float = 0.5, y: float = 0.5) -> None:
        """Click a place in an element."""
        across, down = self.place(selector, x, y)
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, x=across, y=down, button="left", clickCount=1)

    def key(self, name: str) -> None:
        """Press a key that is no letter, such as ArrowLeft or Enter."""
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=name, code=name)

    def slide(self, selector: str, value: float) -> None:
        """Set a slider, as a user would with the keyboard."""
        self.value(
            f"(() => {{ const found = document.querySelector({json.dumps(selector)}); found.value = {value}; "
            "found.dispatchEvent(new Event('input', {bubbles: true})); })()"
        )

    def text(self, selector: str) -> str:
        """Text of an element."""
        return self.value(f"document.querySelector({json.dumps(selector)}).textContent")

    def screenshot(self, *, whole: bool = True) -> bytes:
        """The page as PNG; `whole`: to its end."""
        return base64.b64decode(self.send("Page.captureScreenshot", captureBeyondViewport=whole)["data"])


@contextlib.contextmanager
def browser() -> Iterator[Page]:
    """Context manager with an empty page of a browser for which no name of a host exists."""
    to_read, to_write = os.pipe()
    from_read, from_write = os.pipe()
    with tempfile.TemporaryDirectory() as profile:
        # The protocol's pipes are the file descriptors 3 and 4 of the browser; bash moves them there.
        options = (
            "--remote-debugging-pipe --no-sandbox --headless --disable-gpu-sandbox --enable-unsafe-swiftshader "
            f'--hide-scrollbars --host-resolver-rules="MAP * ~NOTFOUND, EXCLUDE 127.0.0.1" --user-data-dir={profile}'
        )
        script = f"exec 3<&{to_read} 4>&{from_write}; exec {needed()} {options}"
        process = subprocess.Popen(
            ["bash", "-c", script],
            pass_fds=(to_read, from_write),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_read)
        os.close(from_write)
        page = Page(to_write, from_read)
        try:
            page.attach()
            yield page
        finally:
            with contextlib.suppress(BrokenPipeError, AssertionError):
                page.send("Browser.close")
            os.close(to_write)
            os.close(from_read)
            process.wait(timeout=PATIENCE_S)
