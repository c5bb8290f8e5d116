"""Playback of scenes at any time, without torch where possible."""
