"""rendercanvas's canvas for browsers, which is experimental, with corrections."""

from __future__ import annotations

from typing import Any

from rendercanvas.http import HttpRenderCanvas


class RemoteCanvas(HttpRenderCanvas):
    """Pictures go out as JPEG while something moves, and once more as PNG when nothing has for 0.3 seconds.

    The first browser that is connected drives, the others watch.
    """

    def __init__(self, **options: Any) -> None:
        self._sizes: dict[int, dict[str, Any]] = {}  # last resize event of each browser
        super().__init__(**options)

    def _on_event(self, event: dict[str, Any], id: int) -> None:
        driver, kind = self._active_client, event.get("type")
        if kind == "close":  # upstream closes the canvas for everybody
            return
        if kind == "resize":
            self._sizes[id] = dict(event)
        super()._on_event(event, id)
        if self._active_client != driver and self._active_client in self._sizes:  # another one, with another window
            super()._on_event(dict(self._sizes[self._active_client]), self._active_client)

    def _maybe_draw(self) -> None:
        """Also sends a picture later that could not be sent when it was made, since two were on their way: often it is
        the lossless one. Upstream does so only for several browsers."""
        super()._maybe_draw()
        if self._last_frame[0] is not None:
            self._send_last_frame_to_ready_clients()
