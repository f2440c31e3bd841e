"""Pages that change while they are open: drawn once for all who look at them, and sent as server-sent events.

Each event has the sections that have changed, so that a page that is open costs little, and one that was just opened,
or whose connection was lost, gets all of them.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from es_service.logs import logger
from es_service.report.markup import Markup, tag

_LOG = logger(__name__)
SHARE = 0.03
"""Share of one core that drawing and sending may take while pages are open, all of them together."""
LEAST_S, MOST_S = 1.0, 60.0
"""Seconds between two pictures of a page."""
ALIVE_S = 10.0
"""An idle connection gets a comment so often, by which a lost one is noticed."""
LINGER_S = 20.0
"""What was read is kept so long after the last page is closed, since it may only be reloaded."""
_DRAWING = ThreadPoolExecutor(4, "drawing")


class Picture(NamedTuple):
    title: str
    sections: Mapping[str, Markup]
    """By id, in order; an empty one is no part of the page."""
    scripts: Mapping[str, Any]
    """Data of the page's script, by section."""
    more: bool = False
    """Whether there is more to read at once."""


class Allowance:
    """How long a page waits for its next picture, so that all of them together leave the processor to the runs."""

    def __init__(self) -> None:
        self._charged_s, self._free_s = time.process_time(), 0.0

    def pause_s(self, *, first: bool) -> float:
        """Seconds to wait; what this process has used since the last call is paid for, unless it drew a page first."""
        now_s, used_s = time.monotonic(), time.process_time()
        cost_s, self._charged_s = used_s - self._charged_s, used_s
        self._free_s = min(max(self._free_s, now_s) + (0.0 if first else cost_s / SHARE), now_s + MOST_S)
        return 0.0 if first else max(self._free_s - now_s, 0.0)


class PageChannel:
    """A page that is drawn again and again while somebody looks at it."""

    def __init__(self, draw: Callable[[], Picture | None], on_end: Callable[[], object], allowance: Allowance) -> None:
        """`draw`: called in a thread; None if nothing has changed. `on_end`: called when nobody looks any more."""
        self._draw, self._on_end, self._allowance = draw, on_end, allowance
        self._texts: dict[str, str] = {}
        self._title = ""
        self._version = 0
        self._changed = asyncio.Event()
        self._viewers, self._left_s = 0, time.monotonic()
        self._message: tuple[Any, bytes] = (None, b"")
        self._task = asyncio.create_task(self._work())

    async def stream(self) -> AsyncIterator[bytes]:
        """Server-sent events for one viewer."""
        sent: dict[str, str] = {}
        version = 0
        self._viewers += 1
        try:
            yield b"retry: 2000\n\n"
            while True:
                changed = self._changed
                if version != self._version:
                    version = self._version
                    yield self._event(tuple(id_ for id_, text in self._texts.items() if sent.get(id_) != text))
                    sent = self._texts
                try:
                    await asyncio.wait_for(changed.wait(), ALIVE_S)
                except TimeoutError:
                    yield b": alive\n\n"
        finally:
            self._viewers -= 1
            self._left_s = time.monotonic()

    def _event(self, ids: tuple[str, ...]) -> bytes:
        """The event with some sections; most viewers need the same, so the last one is kept."""
        if self._message[0] != (self._version, ids):
            sections = ", ".join(f"{json.dumps(id_)}: {self._texts[id_]}" for id_ in ids)
            head = f'"title": {json.dumps(self._title)}, "order": {json.dumps(list(self._texts))}'
            text = f'data: {{{head}, "sections": {{{sections}}}}}\n\n'
            self._message = (self._version, ids), text.encode(errors="replace")
        return self._message[1]

    async def _work(self) -> None:
        try:
            while self._viewers or time.monotonic() - self._left_s < LINGER_S:
                if not self._viewers:
                    await asyncio.sleep(0.1)
                    continue
                first = self._version == 0
                more = await self._show()
                await asyncio.sleep(0.0 if more else LEAST_S)  # what is sent meanwhile counts, too
                await asyncio.sleep(self._allowance.pause_s(first=first or more))
        finally:
            self._on_end()

    async def _show(self) -> bool:
        """Draw the page, tell all viewers, and return whether there is more to draw at once."""
        try:
            picture = await asyncio.get_running_loop().run_in_executor(_DRAWING, self._encoded)
        except Exception as error:  # the page of one run must not end that of the others
            _LOG.error("a page cannot be drawn", exc_info=error)
            said = tag("section", tag("p", f"This page cannot be drawn: {error}", class_="problem"), id="live")
            picture = self._title, self._texts | {"live": _text(said, None)}, False
        if picture is None:
            return False
        title, texts, more = picture
        if (title, texts) != (self._title, self._texts):
            self._title, self._texts = title, texts
            self._version += 1
            self._changed.set()
            self._changed = asyncio.Event()
        return more

    def _encoded(self) -> tuple[str, dict[str, str], bool] | None:
        picture = self._draw()
        if picture is None:
            return None
        texts = {id_: _text(html, picture.scripts.get(id_)) for id_, html in picture.sections.items() if html}
        return picture.title, texts, picture.more


def _text(html: Markup, data: Any) -> str:
    return json.dumps({"html": html, "data": data}, separators=(",", ":"), allow_nan=False)
