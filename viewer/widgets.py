"""What panels of Dear ImGui have in common: buttons, choices, tooltips."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TypeVar

from imgui_bundle import imgui

T = TypeVar("T")


def button(label: str, width: float = 66, *, enabled: bool = True) -> bool:
    """A button; whether it was pressed."""
    imgui.begin_disabled(not enabled)
    pressed = imgui.button(label, (width, 0))
    imgui.end_disabled()
    return bool(pressed)


def choice(label: str, present: T, choices: Sequence[T], names: Sequence[str] | None = None, width: float = -70) -> T:
    """A list to choose from; the choice, which is `present` until the user takes another. names: of the choices."""
    imgui.set_next_item_width(width)
    at = choices.index(present) if present in choices else -1
    changed, chosen = imgui.combo(label, at, list(map(str, choices if names is None else names)))
    return choices[chosen] if changed else present


def tip(text: str) -> None:
    """What is shown while the pointer rests on the last item."""
    if imgui.is_item_hovered(imgui.HoveredFlags_.allow_when_disabled):
        imgui.set_tooltip(text)


def printable(text: str) -> str:
    """A text that may hold names of files, as UTF-8: others end Dear ImGui's frame with an error."""
    return os.fsencode(text).decode("utf-8", "replace")
