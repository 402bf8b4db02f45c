"""A Chromium that tests drive by its DevTools protocol, over a web socket of a few lines."""

import base64
import json
import os
import re
import socket
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from browser import find_chromium


class Browser:
    """Headless Chromium; `page` opens one more page in it."""

    def __init__(self, folder: Path) -> None:
        self._pages: list[Page] = []
        program = find_chromium()
        assert program is not None
        flags = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run")
        self._process = subprocess.Popen(
            [program, *flags, "--remote-debugging-port=0", f"--user-data-dir={folder}", "about:blank"],
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._process.stderr is not None
        lines = iter(self._process.stderr.readline, "")
        self._port = next(int(found[1]) for line in lines if (found := re.search(r"ws://127\.0\.0\.1:(\d+)/", line)))

    def page(self, address: str, width: int = 1280, height: int = 900, *, dark: bool = False) -> "Page":
        request = urllib.request.Request(f"http://127.0.0.1:{self._port}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(request, timeout=60) as answer:
            page = Page(json.load(answer)["webSocketDebuggerUrl"])
        page.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        page.call("Emulation.setEmulatedMedia", features=scheme)
        page.call("Page.enable")
        page.call("Page.navigate", url=address)
        self._pages.append(page)
        return page

    def close(self) -> None:
        for page in self._pages:
            page.close()
        self._process.kill()
        self._process.communicate()


class Page:
    """Page of a `Browser`: scripts, clicks, keys and pictures."""

    def __init__(self, address: str) -> None:
        parts = urlsplit(address)
        self._socket = socket.create_connection((parts.hostname, parts.port), timeout=300)
        key = base64.b64encode(os.urandom(16)).decode()
        head = f"GET {parts.path} HTTP/1.1\r\nHost: {parts.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        self._socket.sendall(f"{head}Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode())
        self._input = self._socket.makefile("rb")
        while self._input.readline().strip():
            pass
        self._number = 0
        self.clicks = 0

    def close(self) -> None:
        self._input.close()
        self._socket.close()

    def call(self, method: str, **parameters: Any) -> Any:
        self._number += 1
        message = json.dumps({"id": self._number, "method": method, "params": parameters}).encode()
        size = len(message)
        length = bytes([0x80 | size]) if size < 126 else bytes([0xFE]) + size.to_bytes(2, "big")
        length = length if size < 1 << 16 else bytes([0xFF]) + size.to_bytes(8, "big")
        self._socket.sendall(b"\x81" + length + b"\0\0\0\0" + message)  # a mask of zeros
        while True:
            answer = json.loads(self._received())
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def _received(self) -> bytes:
        text, final = b"", False
        while not final:
            first, size = self._input.read(2)
            final, size = bool(first & 0x80), size & 0x7F
            if size > 125:
                size = int.from_bytes(self._input.read(2 if size == 126 else 8), "big")
            text += self._input.read(size)
        return text

    def value(self, script: str) -> Any:
        """Value of a script, which may be a promise."""
        made = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in made, made["exceptionDetails"]
        return made["result"].get("value")

    def until(self, script: str, seconds: float = 120.0) -> Any:
        """Value of a script as soon as it is true."""
        ends = time.monotonic() + seconds
        while not (value := self.value(script)):
            assert time.monotonic() < ends, (script, self.value("document.body.innerText"))
            time.sleep(0.05)
        return value

    def text(self, name: str) -> str:
        return str(self.value(f"document.getElementById({name!r}).textContent"))

    def click(self, script: str) -> None:
        """Click at the middle of the element that a script gives."""
        self.drag_over(script, 0.5, 0.5)
        self.clicks += 1

    def drag_over(self, script: str, start: float, end: float) -> None:
        """Drag over an element, from one share of its width to another."""
        shown = f"(q => (q.scrollIntoView({{block: 'center', behavior: 'instant'}}), q))({script})"
        box = self.value(f"{shown}.getBoundingClientRect().toJSON()")
        places = [box["x"] + share * box["width"] for share in (start, end, end)]
        for kind, x in zip(("mousePressed", "mouseMoved", "mouseReleased"), places, strict=True):
            more = {"x": x, "y": box["y"] + box["height"] / 2, "button": "left", "buttons": 1, "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, **more)

    def fill(self, name: str, text: str) -> None:
        """Put a text into a field, or choose it, as a user who leaves the field afterwards."""
        self.value(
            f"(() => {{ const q = document.getElementById({name!r}); q.value = {text!r};"
            "q.dispatchEvent(new Event('change', {bubbles: true})); })()"
        )

    def picture(self, path: Path, script: str = "document.documentElement") -> None:
        """Write a picture of the element that a script gives, of the whole page by default."""
        place = "{x: b.x + scrollX, y: b.y + scrollY, width: b.width, height: Math.min(b.height, 6000), scale: 1}"
        clip = self.value(f"(b => ({place}))({script}.getBoundingClientRect())")
        data = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)["data"]
        path.write_bytes(base64.b64decode(data))
