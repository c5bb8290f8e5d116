"""What a folder holds, besides the files that desktops keep in it."""

from pathlib import Path

_DESKTOPS = (".DS_Store", "desktop.ini", "Thumbs.db")


def is_desktop_file(name: str) -> bool:
    """Whether macOS or Windows puts files of this name beside others, for itself: attributes, icons, thumbnails."""
    return name in _DESKTOPS or name.startswith("._")


def listed(folder: Path) -> list[Path]:
    """The entries of a folder, by name, but those of the desktop. Raises OSError."""
    return sorted(entry for entry in folder.iterdir() if not is_desktop_file(entry.name))
