"""Pictures of HTML pages as a browser shows them, in windows of any width: figures of the documentation.

``python -m docs.pictures.screenshots PAGE.html OUT.png WIDTH [--height N] [--dark]`` takes the whole page, or its
first N pixels. Chromium is driven over a pipe (https://chromedevtools.github.io/devtools-protocol/), so nothing
else is needed.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from PIL import Image

_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_TALLEST = 16_000  # pixels: Chromium takes no taller picture
# Figures are drawn when they come near: go past them all, then wait until each is there.
_DRAW = """(async () => {
  const pause = (ms) => new Promise((r) => setTimeout(r, ms));
  for (let y = 0; y < document.body.scrollHeight; y += 400) { scrollTo(0, y); await pause(120); }
  const plots = [...document.querySelectorAll(".plot")].filter((p) => p.offsetParent);
  for (let k = 0; k < 100 && plots.some((p) => !p.querySelector(".main-svg")); k++) await pause(200);
  scrollTo(0, 0); await pause(400);
  return document.documentElement.scrollHeight;
})()"""


class Browser:
    """A headless Chromium with one page."""

    def __init__(self, receive: int, send: int) -> None:
        self._in, self._out = os.fdopen(receive, "rb"), os.fdopen(send, "wb")
        self._number, self._left, self._session = 0, b"", ""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Page.enable")

    def close(self) -> None:
        """Close the pipes."""
        self._in.close()
        self._out.close()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command of the protocol and return its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        self._out.write(
            json.dumps(message | ({"sessionId": self._session} if self._session else {})).encode() + b"\0"
        )
        self._out.flush()
        while True:
            answer = self._message()
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return dict(answer["result"])

    def wait_for(self, event: str) -> None:
        """Read on until an event comes."""
        while self._message().get("method") != event:
            pass

    def _message(self) -> dict[str, Any]:
        while b"\0" not in self._left:
            chunk = os.read(self._in.fileno(), 1 << 20)
            if not chunk:
                raise RuntimeError("the browser ended")
            self._left += chunk
        message, self._left = self._left.split(b"\0", 1)
        return dict(json.loads(message))

    def open(self, page: Path, width: int, scheme: Literal["light", "dark"] = "light") -> int:
        """Show `page` in a window of `width` pixels, all of its figures drawn, and return its height."""
        self._window(width, 900)
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        self.call("Page.navigate", url=page.resolve().as_uri())
        self.wait_for("Page.loadEventFired")
        height = int(self.evaluate(_DRAW))
        self._window(width, min(height, _TALLEST))
        return height

    def _window(self, width: int, height: int) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression, awaited."""
        outcome = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in outcome:
            raise RuntimeError(str(outcome["exceptionDetails"]))
        return outcome["result"].get("value")

    def picture(self, width: int, height: int, top: int = 0) -> bytes:
        """Return the open page's pixels from `top` on, as a PNG of few colours."""
        clip = {"x": 0, "y": top, "width": width, "height": min(height, _TALLEST), "scale": 1}
        shot = self.call("Page.captureScreenshot", clip=clip)
        with Image.open(io.BytesIO(base64.b64decode(shot["data"]))) as image:
            small = image.convert("RGB").quantize(48, dither=Image.Dither.NONE)
        file = io.BytesIO()
        small.save(file, "PNG", optimize=True)
        return file.getvalue()

    def printed(self) -> bytes:
        """Return the open page as a PDF, as it would be printed."""
        return base64.b64decode(self.call("Page.printToPDF", preferCSSPageSize=True)["data"])


def program() -> str | None:
    """Return the path of Chromium, if it is installed."""
    return next((path for name in _BROWSERS if (path := shutil.which(name))), None)


@contextmanager
def browser() -> Iterator[Browser]:
    """Start Chromium, and end it with its profile."""
    if (chromium := program()) is None:
        raise SystemExit(f"no browser found: one of {', '.join(_BROWSERS)} takes the pictures")
    ours, its = os.pipe(), os.pipe()  # Chromium reads commands from 3 and answers on 4
    # In a short path, because a socket goes there.
    with tempfile.TemporaryDirectory(dir="/tmp", ignore_cleanup_errors=True) as profile:
        environment = os.environ | {"TMPDIR": profile}
        command = [
            "bash",  # other shells redirect files up to number 9 only
            "-c",
            f'exec "$@" 3<&{ours[0]} 4>&{its[1]}',
            "bash",
            chromium,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--hide-scrollbars",
            "--remote-debugging-pipe",
            f"--user-data-dir={profile}",
        ]
        process = subprocess.Popen(command, pass_fds=(ours[0], its[1]), stderr=subprocess.DEVNULL, env=environment)
        os.close(ours[0])
        os.close(its[1])
        try:
            window = Browser(its[0], ours[1])
            try:
                yield window
            finally:
                window.close()
        finally:
            process.terminate()
            process.wait()


def main() -> None:
    """Take one picture."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("width", type=int)
    parser.add_argument("--height", type=int)
    parser.add_argument("--top", type=int, default=0)
    parser.add_argument("--dark", action="store_true")
    given = parser.parse_args()
    with browser() as shown:
        height = shown.open(given.page, given.width, "dark" if given.dark else "light")
        given.out.write_bytes(
            shown.printed()
            if given.out.suffix == ".pdf"
            else shown.picture(given.width, given.height or height, given.top)
        )


if __name__ == "__main__":
    main()
