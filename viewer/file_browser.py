"""A small file dialog that works the same in a window and in a browser."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from imgui_bundle import imgui

from lapgs_wgpu.viewer.widgets import printable


class FileBrowser:
    """A section of a panel that is closed at first. open_file: called with the .ply or .lapgs that is chosen."""

    def __init__(self, folder: Path, open_file: Callable[[Path], None]) -> None:
        self._folder, self._open_file = folder, open_file
        self._shown = False

    def toggle(self) -> None:
        """Open or close the section."""
        self._shown = not self._shown

    def draw(self) -> None:
        """Draw into the present imgui window."""
        if not self._shown:
            return
        imgui.separator_text("Open")
        imgui.text_wrapped(printable(str(self._folder)))
        imgui.begin_child("files", (0, 180), imgui.ChildFlags_.borders)
        if imgui.selectable("../", False)[0]:
            self._folder = self._folder.parent
        try:
            entries = sorted(self._folder.iterdir())
        except OSError as error:
            entries = []
            imgui.text_wrapped(printable(str(error)))
        for entry in entries:
            if entry.name.startswith("."):
                continue
            name = printable(entry.name)
            if os.path.isdir(entry) and imgui.selectable(f"{name}/", False)[0]:
                self._folder = entry
            elif entry.suffix.lower() in (".ply", ".lapgs") and imgui.selectable(name, False)[0]:
                self._shown = False
                self._open_file(entry)
        imgui.end_child()
