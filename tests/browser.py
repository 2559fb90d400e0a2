"""A page opened in headless Chromium, spoken to over its debugging pipe: what it loads, shows and prints."""

import base64
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

# By the names that distributions give it.
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
ARGUMENTS = (
    "--headless",
    "--no-sandbox",
    "--no-first-run",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--window-size=1200,900",
    "--remote-debugging-pipe",
)


class Browser:
    """A page of a browser; `requests` are the addresses that it has asked for."""

    def __init__(self, profile: Path, *more: str) -> None:
        assert CHROMIUM
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()
        # Chromium reads descriptor 3 and writes descriptor 4.
        script = f'exec 3<&{to_browser} 4>&{from_browser}; exec "$@"'
        self._process = subprocess.Popen(
            ["bash", "-c", script, "bash", CHROMIUM, *ARGUMENTS, *more, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(to_browser, from_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        self._number, self._rest = 0, b""
        self.requests: list[str] = []
        self.events: list[str] = []
        pages = self.ask("Target.getTargets")["targetInfos"]
        target = next(page["targetId"] for page in pages if page["type"] == "page")
        self._session: str | None = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Runtime"):
            self.ask(f"{domain}.enable")

    _session: str | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._write)
        os.close(self._read)

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Return the browser's answer; what it tells meanwhile is kept."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        for each in self._messages():
            if each.get("id") == self._number:
                assert "error" not in each, each
                return dict(each["result"])
        raise AssertionError("the browser has gone")

    def open(self, page: Path) -> None:
        """Open a page and wait until it has loaded."""
        self.ask("Page.navigate", url=page.resolve().as_uri())
        while "Page.loadEventFired" not in self.events:
            next(self._messages())

    def evaluate(self, expression: str) -> Any:
        """Return the value of an expression in the page, when it is there."""
        found = self.ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def print(self, target: Path) -> None:
        """Write the page as PDF."""
        target.write_bytes(base64.b64decode(self.ask("Page.printToPDF", printBackground=True)["data"]))

    def _messages(self) -> Iterator[dict[str, Any]]:
        while True:
            while b"\0" not in self._rest:
                piece = os.read(self._read, 1 << 16)
                assert piece, "the browser has gone"
                self._rest += piece
            message, _, self._rest = self._rest.partition(b"\0")
            reported = json.loads(message)
            if "method" in reported:
                self.events.append(reported["method"])
                if reported["method"] == "Network.requestWillBeSent":
                    self.requests.append(reported["params"]["request"]["url"])
            yield reported


@contextmanager
def opened(page: Path, profile: Path, *more: str) -> Iterator[Browser]:
    """Open a page in a browser of its own, with `more` arguments."""
    with Browser(profile, *more) as browser:
        browser.open(page)
        yield browser
