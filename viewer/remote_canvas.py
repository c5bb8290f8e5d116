"""rendercanvas's canvas for browsers, which is experimental, with what it gets wrong made right."""

from __future__ import annotations

from typing import Any

from rendercanvas.http import HttpRenderCanvas

from lapgs_wgpu.gpu.device import Device


class RemoteCanvas(HttpRenderCanvas):
    """Pictures go out as JPEG while something moves, and once more as PNG when nothing has for 0.3 seconds."""

    def __init__(self, device: Device, **options: Any) -> None:
        self._largest = int(device.wgpu_device.limits["max-texture-dimension-2d"])
        self._sized = False
        self._held: dict[tuple[str, Any], dict[str, Any]] = {}  # what ends each key and button that is down
        super().__init__(**options)

    def _on_event(self, event: dict[str, Any], id: int) -> None:
        driver, kind = self._active_client, event.get("type")
        if kind == "close":  # upstream closes the canvas for everybody
            return
        if kind == "_clients_change" and id:  # the server's own word, which a browser could say, too, to take over
            return
        if id == driver and id:
            self._keep_held(event)
            if kind == "resize":
                event = {
                    **event,
                    **{side: max(1, min(int(event[side]), self._largest)) for side in ("pwidth", "pheight")},
                }
                self._sized = True
        super()._on_event(event, id)
        if self._active_client != driver:  # it left, perhaps in the middle of a drag
            for end in self._held.values():
                self.submit_event(end)
            self._held.clear()
        if kind == "resize":
            self._schedule_maybe_draw()

    def _keep_held(self, event: dict[str, Any]) -> None:
        kind = event.get("type")
        if kind in ("key_down", "key_up"):
            name: tuple[str, Any] = ("key", event["key"])
            end = {"event_type": "key_up", "key": event["key"], "modifiers": ()}
        elif kind in ("pointer_down", "pointer_up"):
            name = ("button", event["button"])
            end = {"event_type": "pointer_up", "modifiers": (), "buttons": (), "ntouches": 0, "touches": {}}
            end |= {field: event[field] for field in ("x", "y", "button")}
        else:
            return
        if kind.endswith("down"):
            self._held[name] = end
        else:
            self._held.pop(name, None)

    def _maybe_draw(self) -> None:
        """As upstream, but not before the first browser has told its size, and a picture that could not be sent when it
        was made (two were on their way) is sent later also where there is only one browser: often it is the lossless
        one."""
        if not self._sized:
            self._pending_maybe_draw = False
            return
        super()._maybe_draw()
        if self._last_frame[0] is not None:
            self._send_last_frame_to_ready_clients()
