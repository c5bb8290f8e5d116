"""Buttons, choices and tooltips of the panels (Dear ImGui)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from imgui_bundle import imgui

T = TypeVar("T")


def button(label: str, width: float = 66) -> bool:
    """Draw a button; returns whether it was pressed."""
    return bool(imgui.button(label, (width, 0)))


def choice(label: str, present: T, choices: Sequence[T], names: Sequence[str] | None = None, width: float = -70) -> T:
    """Draw a list; returns the choice, `present` until the user takes another. names: labels of the choices."""
    imgui.set_next_item_width(width)
    at = choices.index(present) if present in choices else -1
    changed, chosen = imgui.combo(label, at, list(map(str, choices if names is None else names)))
    return choices[chosen] if changed else present


def tip(text: str) -> None:
    """Show a text while the pointer rests on the last item."""
    if imgui.is_item_hovered(imgui.HoveredFlags_.allow_when_disabled):
        imgui.set_tooltip(text)
